# The README's installation in a container:
#   docker build -t vdgs .
#   docker run --rm -v "$PWD:/data" -w /data -u "$(id -u):$(id -g)" vdgs run DCIM --output run
FROM python:3.11-slim
RUN apt-get update \
    && apt-get install -y --no-install-recommends make g++ \
    && rm -rf /var/lib/apt/lists/*
COPY . /vdgs
WORKDIR /vdgs
RUN make setup
# Some libraries look for a home, which the user of `docker run -u` lacks.
ENV HOME=/tmp PATH="/vdgs/.venv/bin:$PATH"
ENTRYPOINT ["vdgs"]
CMD ["--help"]
