# vinesim in a container, from a checkout:
#   docker build -t vinesim .
#   docker run --rm -v "$PWD/out:/out" vinesim    # the demo; the files in out/ belong to root
#   docker run --rm --network host vinesim \
#     vinesim client --role robot --scene demo    # any other command
FROM python:3.12-slim-bookworm AS build
RUN apt-get update && apt-get install -y --no-install-recommends nodejs npm && rm -rf /var/lib/apt/lists/*
COPY . /vinesim
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels /vinesim

FROM python:3.12-slim-bookworm
# g++ compiles the ROS message packages that have no wheel
RUN apt-get update && apt-get install -y --no-install-recommends g++ && rm -rf /var/lib/apt/lists/*
COPY --from=build /wheels /wheels
COPY constraints.txt /wheels/constraints.txt
RUN pip install --no-cache-dir --constraint /wheels/constraints.txt "$(ls /wheels/vinesim-*.whl)[ros,web,tune]"
WORKDIR /vineyard
# compiled here, so that no container compiles at its start
RUN vinesim ros build-interfaces --quiet && python -m vinesim.kernels.compilation && vinesim examples
VOLUME /out
CMD ["vinesim", "demo", "--headless", "--seconds", "20", "--out", "/out"]
