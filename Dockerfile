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

# Compiles the kernels, so that the first photo need not wait for them. The picture shows a thing before
# a wall, because outlines have kernels of their own; the exports are those that the server makes.
RUN mkdir -p /opt/spackle/kernels /opt/spackle/weights /opt/spackle/home /opt/spackle/work/scenes \
    && python -c "import numpy; from PIL import Image; rows, columns = numpy.indices((96, 128)); Image.fromarray(numpy.where((abs(rows - 60) < 30) & (abs(columns - 64) < 20), 255, rows + columns).astype('uint8')).save('/opt/spackle/first.png')" \
    && spackle predict /opt/spackle/first.png -o /opt/spackle/first --frames 2 \
    && spackle export /opt/spackle/first/first/scene.ply -o /opt/spackle/first/a.spz -o /opt/spackle/first/a.sog -o /opt/spackle/first/a.glb -o /opt/spackle/first/a.html \
    && rm -rf /opt/spackle/first /opt/spackle/first.png \
    && chmod -R a+rwX /opt/spackle/kernels /opt/spackle/weights /opt/spackle/home /opt/spackle/work

# Any user may run it: docker run --user "$(id -u):$(id -g)"
USER 1000
WORKDIR /opt/spackle/work
EXPOSE 8000
ENTRYPOINT ["spackle"]
CMD ["--help"]
