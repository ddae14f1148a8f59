#!/usr/bin/env bash
# The paper's tables at the paper's size: benchmarks/paper_scale.sh DATA [OPTION ...]
#
# Traces six scenes of 6,000 positions into the folder DATA (extra: raytrace) and measures every method on them. It continues
# where it was stopped: a scene, a fit or a run that is finished is not repeated. --quick measures one scene of 300 positions. Options
# are those of paper_scale.py. Each scene has a process of its own, which bounds the memory.
set -euo pipefail

if (($# < 1)); then
  echo "usage: benchmarks/paper_scale.sh DATA [OPTION ...]" >&2
  exit 2
fi
data=$(realpath -m "$1")
shift
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}

scenes=(conference-transmitter conference-receiver office-transmitter office-receiver bedroom-transmitter bedroom-receiver)
if [[ " $* " == *" --quick "* ]]; then scenes=(conference-transmitter); fi
for scene in "${scenes[@]}"; do
  "$python" benchmarks/paper_scale.py --data "$data" --only "$scene" "$@"
done
"$python" benchmarks/tables.py
