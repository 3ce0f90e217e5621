#!/bin/sh
# A card in under four minutes: install, compare bits, measure, write the record. Run it where a card is at hand:
#   sh benchmarks/gpu.sh [FOLDER]
# FOLDER gets cuda.json, with the card's name (default: benchmarks/results). PYTHON chooses the interpreter.
set -eu
cd "$(dirname "$0")/.."
out=${1:-benchmarks/results}
python=${PYTHON:-python3}
if ! "$python" -c 'import tailgate, cuda.bindings' 2>/dev/null; then
  "$python" -m venv .venv-gpu
  python=.venv-gpu/bin/python
  "$python" -m pip install --quiet --constraint constraints.txt --editable '.[cuda]'
fi
# fingerprints of published episodes; the others: --check --device cuda without a scenario, some minutes
"$python" -m tailgate.evaluation.golden --check --device cuda --scenario stop-and-go-v0 --scenario radar-following-v0
# the platoon under chi2_dkf takes a minute more to compile: --only "platoon of 5, chi2_dkf"
"$python" -m tailgate bench --device cuda --only "car following" --only radar --only "platoon of 5" --rounds 5 --seconds 0.5 --out "$out"
