# Maps logs that are mounted into it:
#   docker build --tag mapper .
#   docker run --rm --user "$(id -u):$(id -g)" --volume "$PWD:/data" mapper build LOG --out RUN
# EXTRAS=[viewer,mesh] and the like add optional parts; without, core alone.
FROM python:3.12-slim-bookworm AS wheel
WORKDIR /source
COPY . .
RUN MAPPER_KERNELS=0 python -m pip wheel --no-cache-dir --no-deps --wheel-dir /wheel .

FROM python:3.12-slim-bookworm
ARG EXTRAS=""
RUN --mount=type=bind,from=wheel,source=/wheel,target=/wheel \
    python -m pip install --no-cache-dir --only-binary :all: "$(echo /wheel/*.whl)${EXTRAS}" \
    && useradd --create-home --uid 1000 mapper \
    && install --directory --owner mapper --mode 0777 /var/cache/mapper /data
ENV NUMBA_CACHE_DIR=/var/cache/mapper HOME=/tmp MPLCONFIGDIR=/tmp/matplotlib
USER 1000
RUN mapper doctor --warm --quiet && chmod -R a+rwX /var/cache/mapper
WORKDIR /data
ENTRYPOINT ["mapper"]
CMD ["--help"]
