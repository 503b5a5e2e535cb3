# docker build -t spackle .     with CUDA: --build-arg TORCH_INDEX=https://download.pytorch.org/whl/cu130
FROM python:3.12-slim-bookworm

ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
ENV PIP_NO_CACHE_DIR=1 \
    PIP_DISABLE_PIP_VERSION_CHECK=1 \
    NUMBA_CACHE_DIR=/opt/spackle/kernels \
    SPACKLE_WEIGHTS=/opt/spackle/weights \
    HOME=/opt/spackle/home

WORKDIR /opt/spackle/source
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY src ./src
RUN pip install --constraint constraints.txt --extra-index-url "$TORCH_INDEX" torch \
    && pip install --constraint constraints.txt '.[train]' \
    && rm -rf build src/*.egg-info

# Compiles the kernels for the processor that builds; another one compiles its own at the first run.
RUN mkdir -p /opt/spackle/kernels /opt/spackle/weights /opt/spackle/home /opt/spackle/work \
    && python -c "import numpy; from PIL import Image; Image.fromarray((numpy.indices((96, 128)).sum(0) % 256).astype('uint8')).save('/opt/spackle/first.png')" \
    && spackle predict /opt/spackle/first.png -o /opt/spackle/first --frames 2 \
    && rm -rf /opt/spackle/first /opt/spackle/first.png \
    && chmod -R a+rwX /opt/spackle/kernels /opt/spackle/weights /opt/spackle/home /opt/spackle/work

# Any user may run it: docker run --user "$(id -u):$(id -g)"
USER 1000
WORKDIR /opt/spackle/work
EXPOSE 8000
ENTRYPOINT ["spackle"]
CMD ["--help"]
