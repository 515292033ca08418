# Use as `. flower/env.sh` in the checkout: puts this project's programs on PATH and keeps Flower's and the book's files
# here.
export PATH="$PWD/.venv/bin:$PATH"
export FLWR_HOME="${FLWR_HOME:-$PWD/.cache/flwr}" FEDVLA_CACHE="${FEDVLA_CACHE:-$PWD/.cache/fedvla}"
export FLWR_TELEMETRY_ENABLED=0 FLWR_DISABLE_UPDATE_CHECK=1 FLWR_DISABLE_RUNTIME_DEPENDENCY_INSTALLATION=1
export RAY_USAGE_STATS_ENABLED=0
