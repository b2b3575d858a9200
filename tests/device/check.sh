#!/usr/bin/env bash
# A GPU against the same machine's CPU in under 8 minutes: CUDA cases of the tests, the demo, detection, the solver and
# device batches over recordings.
#
#     bash tests/device/check.sh [--cpu] [--out FOLDER]
#
# Needs Python 3.11 or newer with the packages of pyproject.toml (PYTHON=... names it; else .venv, else python3).
# --cpu tries the script itself where there is no GPU, on small sizes. Exit code: 0 if every part did its work.
set -uo pipefail
cd "$(dirname "$0")/../.."

device=cuda small="" out="" patience=1
while [ $# -gt 0 ]; do
  case $1 in
    --cpu) device=cpu small=--small patience=10 ;; # not what the limits are made for
    --out) shift; out=${1:?"--out: a folder"} ;;
    *) echo "unknown: $1 (known: --cpu, --out FOLDER)" >&2; exit 2 ;;
  esac
  shift
done
out=${out:-$(mktemp -d)}
mkdir -p "$out"
python=${PYTHON:-$([ -x .venv/bin/python ] && echo .venv/bin/python || echo python3)}
export PYTHONPATH="$PWD${PYTHONPATH:+:$PYTHONPATH}"
failed=0

part() { # name, seconds, command...
  local name=$1 limit=$(($2 * patience)) began=$SECONDS code
  shift 2
  echo "== $name"
  timeout "$limit" "$@"
  code=$?
  [ "$code" -eq 124 ] && echo "stopped after $limit s"
  [ "$code" -eq 0 ] || { failed=1; echo "FAILED: $name (exit code $code)"; }
  echo "== $name: $((SECONDS - began)) s"
}

tests() {
  if [ "$device" = cuda ]; then
    "$python" -m pytest -q -p no:xdist tests/geometry tests/kinematics tests/solver/test_differentiable.py \
      tests/vision/test_detector.py tests/data_synth/test_synth_render.py tests/io/test_frame_source.py \
      -k "cuda or device"
  else
    "$python" -m pytest -q -p no:xdist tests/geometry/test_geometry_cuda.py
  fi
}

demo() {
  "$python" -m rmis_calib demo --device "$1" --out "$out/demo_$1" --overwrite | tail -n 12
}

batches() { # each worker its own, then all together: outputs must agree, and what it takes is printed
  "$python" tests/benchmarks/bench_device_batch.py --device "$device" "$@"
}

export -f tests demo batches
export python device out
"$python" -c 'import sys, torch; sys.exit(0 if sys.argv[1] == "cpu" or torch.cuda.is_available() else "no CUDA device here (--cpu tries the script itself)")' "$device" || exit 2
part "CUDA cases of the tests" 120 bash -c tests
if [ "$device" = cuda ]; then
  part "demo on the CPU" 60 bash -c "demo cpu"
fi
part "demo on $device" 60 bash -c "demo $device"
part "detection and solver" 180 "$python" tests/device/measure.py --device "$device" $small
if [ "$device" = cuda ]; then
  part "batches over recordings" 120 bash -c "batches --recordings 8 --motions 48 --width 640 --workers 8"
else
  part "batches over recordings" 30 bash -c "batches --recordings 2 --motions 4 --workers 2"
fi
echo "left in $out"
exit $failed
