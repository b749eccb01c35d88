# Two images: `server` plays games and serves actions, without PyTorch; `trainer` also trains.
#
#     docker build --target server --tag policy-league:0.1.0 .
#     docker build --target trainer --tag policy-league-trainer:0.1.0 .
#
#     docker volume create league
#     docker run --rm -v league:/league policy-league:0.1.0 league keys create ops --scope act --scope read
#     docker run -v league:/league -p 8000:8000 -p 8001:8001 --shm-size 1g policy-league:0.1.0
#     docker run --rm -v league:/league --shm-size 4g policy-league-trainer:0.1.0 league train connect_four
#
# hadolint accepts this file. It has not been built where it was written, for lack of a container engine.

ARG BASE=python:3.11-slim-bookworm

FROM ${BASE} AS wheel
SHELL ["/bin/bash", "-o", "pipefail", "-c"]
WORKDIR /source
COPY . .
RUN pip install --no-cache-dir build==1.6.1 && python -m build --wheel --outdir /dist

# What is common to both images. Ray keeps its session in /tmp/ray and shared memory in /dev/shm. KubeRay's probes use
# wget.
FROM ${BASE} AS runtime
# hadolint ignore=DL3008
RUN apt-get update && apt-get install --yes --no-install-recommends wget && rm -rf /var/lib/apt/lists/*
RUN groupadd --gid 1000 league && useradd --uid 1000 --gid league --create-home league \
    && install --directory --owner league --group league /league
ENV PATH=/opt/league/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    ORT_DISABLE_TELEMETRY=1 \
    RAY_USAGE_STATS_ENABLED=0 \
    LEAGUE_HOME=/league
WORKDIR /league
USER 1000:1000

FROM wheel AS server-packages
RUN python scripts/without_trainer.py pyproject.toml && python -m build --wheel --outdir /server
RUN python -m venv /opt/league \
    && wheel=$(echo /server/*.whl) \
    && /opt/league/bin/pip install --no-cache-dir --constraint constraints.txt "${wheel}[object-store,postgres]"

FROM runtime AS server
COPY --from=server-packages /opt/league /opt/league
EXPOSE 8000 8001
HEALTHCHECK --interval=10s --timeout=5s --start-period=120s --retries=3 \
    CMD ["python", "-c", "import httpx; httpx.get('http://127.0.0.1:8000/v1/health/ready', trust_env=False).raise_for_status()"]
CMD ["league", "serve", "--host", "0.0.0.0"]

# box2d and rlcard are compiled or packed from their sources.
FROM wheel AS trainer-packages
# hadolint ignore=DL3008
RUN apt-get update && apt-get install --yes --no-install-recommends build-essential swig && rm -rf /var/lib/apt/lists/*
RUN python -m venv /opt/league \
    && wheel=$(echo /dist/*.whl) \
    && /opt/league/bin/pip install --no-cache-dir --constraint constraints.txt "${wheel}[environments,object-store,openspiel,optuna,postgres]"

FROM runtime AS trainer
COPY --from=trainer-packages /opt/league /opt/league
# It runs commands that end.
HEALTHCHECK NONE
CMD ["league", "--help"]
