# The program in a virtual environment, without what built it. How it is run: docs/how-to/docker.md.
#
# The base may be any Debian or Ubuntu whose python3 is 3.11, of which locks/torch-cpu.txt has the hashes.
ARG BASE=debian:bookworm-slim

FROM ${BASE} AS python
RUN apt-get update \
    && apt-get install --yes --no-install-recommends python3 \
    && rm -rf /var/lib/apt/lists/*


FROM python AS build
RUN apt-get update \
    && apt-get install --yes --no-install-recommends python3-venv \
    && rm -rf /var/lib/apt/lists/*
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_ROOT_USER_ACTION=ignore
WORKDIR /build

# pip stays in an environment of its own: the one that is kept has none.
RUN python3 -m venv /opt/pip && python3 -m venv --without-pip /opt/venv

# PyTorch first, in a layer of its own: it is large and changes seldom. Wheels without CUDA are on PyTorch's own index
# of CPU wheels, whose address is TORCH_INDEX; where pip finds none, auto takes the larger one with CUDA, which runs
# without a GPU too.
ARG TORCH=auto
ARG TORCH_INDEX=
COPY locks/torch-*.txt ./
RUN torch() { \
        /opt/pip/bin/pip --python /opt/venv/bin/python install --no-deps --require-hashes \
            ${TORCH_INDEX:+--extra-index-url "$TORCH_INDEX"} --requirement "torch-$1.txt"; \
    }; \
    if [ "$TORCH" != auto ]; then torch "$TORCH"; \
    else torch cpu || { echo "No PyTorch without CUDA where pip looks: taking the one with it" >&2; torch cuda; }; fi
# Without what compiles against it, and its own tests.
RUN cd /opt/venv/lib/python3*/site-packages/torch && rm -rf include test bin/test_*

COPY locks/image.txt locks/build.txt ./
RUN /opt/pip/bin/pip --python /opt/venv/bin/python install --no-deps --require-hashes --requirement image.txt \
    && /opt/pip/bin/pip install --require-hashes --requirement build.txt

COPY pyproject.toml README.md LICENSE ./
COPY agalign ./agalign
RUN /opt/pip/bin/pip wheel --no-deps --no-index --no-build-isolation --wheel-dir dist . \
    && /opt/pip/bin/pip --python /opt/venv/bin/python install --no-deps --no-index dist/*.whl \
    && /opt/pip/bin/pip --python /opt/venv/bin/python check


FROM python
# What a registry shows: --build-arg VERSION=, REVISION= and SOURCE=, the address of the source.
ARG VERSION=
ARG REVISION=
ARG SOURCE=
LABEL org.opencontainers.image.title="agalign" \
      org.opencontainers.image.version="$VERSION" \
      org.opencontainers.image.revision="$REVISION" \
      org.opencontainers.image.source="$SOURCE" \
      org.opencontainers.image.description="Co-registers the bands of multispectral drone cameras" \
      org.opencontainers.image.licenses="MIT"
COPY --from=build /opt/venv /opt/venv
# Nothing is written but the output and, while it runs, /tmp; so any user may run it (--user), known here or not.
RUN useradd --uid 1000 --no-create-home --home-dir /tmp agalign && install --directory --owner=agalign /data
ENV PATH=/opt/venv/bin:$PATH HOME=/tmp PYTHONDONTWRITEBYTECODE=1
# By its number, which is how a cluster sees that it is not root.
USER 1000:1000
WORKDIR /data
ENTRYPOINT ["agalign"]
CMD ["--help"]
