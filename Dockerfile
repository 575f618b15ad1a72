# The same on a Mac, on Windows and in a hosted editor:
#   docker build -t thesis-repro . && docker run --rm -it -p 127.0.0.1:8888:8888 thesis-repro
# opens the notebooks (an address with its token is printed). Other commands: docker run ... thesis-repro make figures
FROM python:3.12-slim AS tools
RUN apt-get update && apt-get install --yes --no-install-recommends git make && rm -rf /var/lib/apt/lists/* \
 && useradd --create-home --shell /bin/bash reader
USER reader

# .devcontainer stops here and installs into the folder that it opens
FROM tools
RUN mkdir /home/reader/thesis-repro  # Podman's WORKDIR would make it root's
WORKDIR /home/reader/thesis-repro
COPY --chown=reader . .
RUN make setup
EXPOSE 8888
CMD ["make", "lab", "LISTEN=0.0.0.0"]
