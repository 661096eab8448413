# V2HDM on a CPU, for mapping:
#   docker build -t v2hdm .
#   docker run --rm -u "$(id -u):$(id -g)" -v "$PWD:/work" v2hdm map drive.path=drives/mysite
FROM python:3.11-slim AS build
WORKDIR /src
# The detector's kernels are compiled; the image itself needs no compiler.
RUN apt-get update && apt-get install -y --no-install-recommends g++ && rm -rf /var/lib/apt/lists/*
COPY . .
# The constraints name a torch without CUDA on this index: with it the image has gigabytes less.
RUN python -m venv /opt/v2hdm \
    && /opt/v2hdm/bin/pip install --no-cache-dir -c constraints.txt \
       --extra-index-url https://download.pytorch.org/whl/cpu '.[map]'

FROM python:3.11-slim
COPY --from=build /opt/v2hdm /opt/v2hdm
RUN useradd --create-home v2hdm && mkdir /work && chown v2hdm /work
# Caches of compiled kernels and fonts need a home that any user may write to.
ENV PATH=/opt/v2hdm/bin:$PATH HOME=/home/v2hdm
RUN chmod 1777 /home/v2hdm
USER v2hdm
WORKDIR /work
ENTRYPOINT ["v2hdm"]
CMD ["--help"]
