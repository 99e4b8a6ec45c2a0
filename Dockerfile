# NGO in a container:   docker build -t ngo . && docker run --rm -v "$PWD/out:/ngo/demo/out" ngo
# With a lidar alone:   docker build -t ngo --build-arg FOR=lidar . && docker run --rm -it --network host ngo bash
FROM debian:12-slim
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 python3-venv python3-dev g++ cmake git make \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /ngo
COPY . .
ARG FOR=all
RUN make build FOR=$FOR
CMD ["make", "demo"]
