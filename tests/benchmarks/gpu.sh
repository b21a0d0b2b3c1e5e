#!/usr/bin/env bash
# Print the table of speeds on the accelerator at hand, in at most 8 minutes: tests/benchmarks/gpu.sh
# With --smoke, run every row with tiny sizes on any machine, to check that the script works.
set -euo pipefail
cd "$(dirname "$0")"
export PYTHONPATH="$PWD:$PWD/../..${PYTHONPATH:+:$PYTHONPATH}"
# JAX reads its settings before the modules that use it are imported.
exec python -c "from jaxhil.simulation.jax_environment import prepare_jax
prepare_jax()
import gpu
gpu.main()" "$@"
