# The demo in a container: docker build -t uika . && docker run --rm -v "$PWD/out:/out" uika
# pip may choose a build of torch for graphics cards that nothing here uses; to avoid it, name an index of builds for processors:
# docker build --build-arg CPU_INDEX=URL -t uika .
FROM python:3.12-slim-trixie
ARG CPU_INDEX=""
RUN apt-get update \
 && apt-get install -y --no-install-recommends libllvm19 espeak-ng \
 && rm -rf /var/lib/apt/lists/*
WORKDIR /app
COPY . .
RUN if [ -n "$CPU_INDEX" ]; then pip install --no-cache-dir -c constraints.txt --index-url "$CPU_INDEX" torch; fi \
 && pip install --no-cache-dir -c constraints.txt ./drjit_splat '.[cli,photo]'
ENV OMP_WAIT_POLICY=passive
VOLUME /out
ENTRYPOINT ["uika"]
CMD ["demo", "-o", "/out"]
