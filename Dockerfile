# The program with its weights inside: once built, it needs no network.
#   docker build -t lightdepth .          (a CPU build of torch is a tenth of the size: --build-arg TORCH_INDEX=URL)
#   docker run --rm --network none --user "$(id -u):$(id -g)" -v "$PWD:/work" lightdepth densify data/mine -o runs/dense
FROM python:3.11-slim

# What Open3D links against; libusb comes with its pip package.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libgl1 libegl1 libx11-6 libgomp1 \
    && rm -rf /var/lib/apt/lists/*

ARG TORCH_INDEX=
WORKDIR /src
COPY constraints.txt ./
RUN if [ -n "$TORCH_INDEX" ]; then pip install --no-cache-dir --index-url "$TORCH_INDEX" "$(grep '^torch==' constraints.txt)"; fi
COPY pyproject.toml README.md LICENSE ./
COPY configs configs
COPY lightdepth lightdepth
COPY densify densify
COPY train train
RUN pip install --no-cache-dir -c constraints.txt ".[onnx]"

# Any user may run it: caches go where everyone can write. Hubs are never asked.
ENV HOME=/tmp MPLCONFIGDIR=/tmp/matplotlib NUMBA_CACHE_DIR=/tmp/numba HF_HUB_OFFLINE=1 OMP_WAIT_POLICY=passive
WORKDIR /work
RUN rm -rf /src && lightdepth doctor && rm -rf /tmp/*
ENTRYPOINT ["lightdepth"]
CMD ["--help"]
