# For `. flower/env.sh` in the checkout: this project's programs, and its own places for what Flower and the book keep.
export PATH="$PWD/.venv/bin:$PATH"
export FLWR_HOME="${FLWR_HOME:-$PWD/.cache/flwr}" FEDVLA_CACHE="${FEDVLA_CACHE:-$PWD/.cache/fedvla}"
export FLWR_TELEMETRY_ENABLED=0 FLWR_DISABLE_UPDATE_CHECK=1 FLWR_DISABLE_RUNTIME_DEPENDENCY_INSTALLATION=1
export RAY_USAGE_STATS_ENABLED=0
