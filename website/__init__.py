"""The site's pages that are made from the code: environments, policies, suites, commands, papers."""
