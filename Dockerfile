# docker build -t spackle .     with CUDA: --build-arg TORCH_INDEX=https://download.pytorch.org/whl/cu130
FROM python:3.12-slim-bookworm

ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
# Kernels for every processor of the image's kind; x86-64-v3 needs AVX2 (since 2013).
ARG CPU=generic
ENV PIP_NO_CACHE_DIR=1 \
    PIP_DISABLE_PIP_VERSION_CHECK=1 \
    NUMBA_CPU_NAME=$CPU \
    NUMBA_CPU_FEATURES= \
    NUMBA_CACHE_DIR=/opt/spackle/kernels \
    SPACKLE_WEIGHTS=/opt/spackle/weights \
    HOME=/opt/spackle/home

WORKDIR /opt/spackle/source
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY src ./src
RUN pip install --constraint constraints.txt --extra-index-url "$TORCH_INDEX" torch \
    && pip install --constraint constraints.txt '.[train]' \
    && rm -rf build src/*.egg-info

# Compiles the kernels, as the server does while its page is empty: the first photo need not wait for them.
RUN mkdir -p /opt/spackle/kernels /opt/spackle/weights /opt/spackle/home /opt/spackle/work/scenes \
    && python -c "from spackle.results.warm_up import compile_kernels; compile_kernels()" \
    && chmod -R a+rwX /opt/spackle/kernels /opt/spackle/weights /opt/spackle/home /opt/spackle/work

# Any user may run it: docker run --user "$(id -u):$(id -g)"
USER 1000
WORKDIR /opt/spackle/work
EXPOSE 8000
ENTRYPOINT ["spackle"]
CMD ["--help"]
