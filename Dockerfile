# The base may be any Debian or Ubuntu with Python 3.11 or newer to be had from apt.
ARG BASE=debian:bookworm-slim
FROM ${BASE}

RUN apt-get update \
    && apt-get install --yes --no-install-recommends python3 python3-venv \
    && rm -rf /var/lib/apt/lists/*

RUN useradd --create-home --uid 1000 agalign
WORKDIR /opt/agalign
ENV PATH=/opt/venv/bin:$PATH PIP_NO_CACHE_DIR=1 PYTHONDONTWRITEBYTECODE=1

# PyTorch first, in a layer of its own: it is large and changes seldom.
COPY constraints.txt ./
RUN python3 -m venv /opt/venv && pip install -c constraints.txt torch

COPY pyproject.toml README.md LICENSE ./
COPY agalign ./agalign
RUN pip install -c constraints.txt .

USER agalign
WORKDIR /data
ENTRYPOINT ["agalign"]
CMD ["--help"]
