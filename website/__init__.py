"""Pages of the site made from the code: environments, policies, suites, commands, papers."""
