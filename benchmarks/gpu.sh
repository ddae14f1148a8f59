#!/usr/bin/env bash
# All that is measured on a GPU, in one call of at most ten minutes: benchmarks/gpu.sh [FOLDER]
#
# Leaves the results, and a log of each part, in FOLDER (benchmarks/results unless given); gpu_parts.json says how each part
# ended. A part that fails or takes too long costs no other. It needs python3 with pip: what is missing of the project is
# installed into a virtual environment beside the code, which sees the packages of the machine, so that a torch that is
# there is used. Without a GPU everything is tried on the CPU, in tiny sizes.
set -uo pipefail

folder=$(realpath -m "${1:-$(dirname "$0")/results}")
cd "$(dirname "$0")/.."
mkdir -p "$folder"
python=${PYTHON:-python3}
whole=${GPU_SECONDS:-590} # for everything; a part gets what its line below says, or what is left
records=()

part() { # NAME SECONDS COMMAND...: runs it, and notes how it ended
  local name=$1 limit=$2 began=$SECONDS state code left=$((whole - SECONDS))
  shift 2
  if ((left < limit)); then limit=$left; fi
  if ((limit < 1)); then
    state="left out: no time"
  else
    timeout --kill-after=5 "$limit" "$@" >"$folder/gpu_$name.log" 2>&1 </dev/null
    code=$?
    case $code in
      0) state=done ;;
      124 | 137) state="stopped after $limit s" ;;
      *) state="failed with code $code" ;;
    esac
  fi
  note "$name" "$state" $((SECONDS - began))
}

note() { # NAME STATE SECONDS
  records+=("{\"part\": \"$1\", \"state\": \"$2\", \"seconds\": $3}")
  printf '%-12s %s, %s s\n' "$1" "$2" "$3"
}

if ! "$python" -c "import pytest, swiftwrf, tasks" 2>/dev/null; then
  part environment 60 "$python" -m venv --system-site-packages .venv-gpu
  [[ -x .venv-gpu/bin/python ]] && python=$PWD/.venv-gpu/bin/python
  part install 300 "$python" -m pip install --quiet --editable '.[dev]'
fi

if "$python" -c "import sys, torch; sys.exit(not torch.cuda.is_available())" 2>/dev/null; then
  size=(--device cuda)
else
  echo "no GPU that torch can use: tiny sizes on the CPU"
  size=(--device cpu --quick)
fi

part tests 240 "$python" -m pytest -m cuda -p no:cacheprovider tests/swiftwrf tests/benchmarks/test_gpu_benchmark.py tests/tasks/aoa
part rasterize 150 "$python" benchmarks/rasterize.py "${size[@]}" --seconds 0.1 --out "$folder"
part rates 90 "$python" benchmarks/gpu.py rates "${size[@]}" --out "$folder"
part profile 90 "$python" benchmarks/gpu.py profile "${size[@]}" --out "$folder"
part training 120 "$python" benchmarks/gpu.py training "${size[@]}" --out "$folder"
if command -v compute-sanitizer >/dev/null; then
  for tool in racecheck initcheck synccheck; do # memcheck is one of the tests
    part "$tool" 60 compute-sanitizer --tool "$tool" --error-exitcode 1 \
      "$python" -m pytest -m cuda -p no:cacheprovider tests/swiftwrf/rasterize/test_cuda.py -k "test_small_hard_cases and gpu and (seam or pole)"
  done
else
  note sanitizer "left out: compute-sanitizer is not installed" 0
fi

{
  echo "["
  printf '%s\n' "${records[@]}" | paste -sd, | sed 's/},{/},\n{/g'
  echo "]"
} >"$folder/gpu_parts.json"
echo "results and logs: $folder"
