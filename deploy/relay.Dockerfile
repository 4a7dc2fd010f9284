# A relay alone, without root: the image of compose.yaml.
FROM python:3.12-slim
WORKDIR /bufgym
COPY . .
RUN pip install --no-cache-dir . ./packages/robot "./packages/relay[mesh]" \
 && useradd --system --uid 10001 relay \
 && install -d -o relay /held /cache
USER relay
WORKDIR /held
ENV BUFGYM_CACHE=/cache PYTHONUNBUFFERED=1
EXPOSE 7420
ENTRYPOINT ["bufgym", "relay"]
CMD ["serve", "--config", "/etc/bufgym/relay.toml"]
