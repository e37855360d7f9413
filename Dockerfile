# docker build -t rlftsim .
# docker build -t rlftsim --build-arg TORCH_INDEX=https://download.pytorch.org/whl/cu130 .      with CUDA
# docker run --rm -v "$PWD:/work" --user "$(id -u)" rlftsim simulate demo-tuned --data synthetic --out rollouts
ARG PYTHON=3.12
FROM python:${PYTHON}-slim

ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
ARG EXTRAS=all
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1 OMP_WAIT_POLICY=PASSIVE

WORKDIR /opt/rlftsim
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY src src
# constraints.txt pins torch, which comes from the index of its builds
RUN pip install --index-url "$TORCH_INDEX" --requirement constraints.txt \
    && pip install --constraint constraints.txt ".[$EXTRAS]"

RUN useradd --create-home rlftsim && install --directory --owner=rlftsim /work
USER rlftsim
WORKDIR /work
ENTRYPOINT ["rlftsim"]
CMD ["--help"]
