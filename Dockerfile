# The two commands in a container:
#   docker build -t bufgym .
#   docker run --rm -v "$PWD/runs:/bufgym/runs" bufgym              make train
#   docker run --rm bufgym make test
FROM python:3.12-slim
# hadolint ignore=DL3008
RUN apt-get update \
 && apt-get install -y --no-install-recommends chromium git make \
 && rm -rf /var/lib/apt/lists/*
WORKDIR /bufgym
COPY . .
# Setting up is a rule of the Makefile; compiling beforehand spares every run half a minute.
RUN make .venv/.ready
CMD ["make", "train"]
