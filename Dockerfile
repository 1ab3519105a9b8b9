# One image for the emulator, the agents and the recorder; `compose.yaml` starts them.
FROM python:3.11-slim
WORKDIR /vnet
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY vnet vnet
COPY agents agents
COPY emulator emulator
RUN pip install --no-cache-dir -c constraints.txt '.[cooperative,maps,plots,rerun]'
COPY scenarios scenarios
