#!/bin/sh
# Wheel and sdist in empty environments of every Python that is found: installed, played, traced, trained, and a sample of the tests.
#   sh benchmarks/pythons.sh [PYTHON ...]
# Without arguments it takes python3.11 and later on the PATH and of pyenv, one of each version. LIGHT=1 leaves out the extra
# train, as torch is gigabytes on Linux. JOBS (default: 1) is the number of processes of the tests.
set -eu
cd "$(dirname "$0")/.."
root=$PWD
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
export PIP_DISABLE_PIP_VERSION_CHECK=1 TAILGATE_CACHE="$work/cache"

version() { "$1" -c 'import sys; print("%d.%d.%d" % sys.version_info[:3]) if sys.version_info >= (3, 11) else None' 2>/dev/null || true; }

if [ $# -eq 0 ]; then
  seen=" "
  for minor in 11 12 13 14 15; do
    for python in "python3.$minor" "${PYENV_ROOT:-$HOME/.pyenv}"/versions/3."$minor".*/bin/python3; do
      found=$(version "$python")
      case "$seen$found" in *" 3.$minor "* | *" ") ;; *) seen="$seen""3.$minor "; set -- "$@" "$python" ;; esac
    done
  done
fi
[ $# -gt 0 ] || { echo "no Python from 3.11 on was found" >&2; exit 1; }

install() { "$1" -m pip install --quiet --constraint "$root/constraints.txt" "$2" && "$1" -m pip check; }
quiet() { "$@" >"$work/log" 2>&1 || { cat "$work/log"; return 1; }; }
stage() { now=$(date +%s); echo "$found  $1  $((now - then)) s"; then=$now; }

"$1" -m venv "$work/build"
"$work/build/bin/python" -m pip install --quiet build twine check-wheel-contents
quiet "$work/build/bin/python" -m build --outdir "$work/dist" .
"$work/build/bin/python" -m twine check --strict "$work"/dist/*
"$work/build/bin/check-wheel-contents" "$work"/dist/*.whl
wheel=$(ls "$work"/dist/*.whl) sdist=$(ls "$work"/dist/*.tar.gz)

cat >"$work/first.py" <<'P'
import sys
import warnings
from importlib.metadata import files
from importlib.util import find_spec

warnings.simplefilter("error")
import gymnasium  # noqa: E402

env = gymnasium.make("tailgate:tailgate/CarFollowing-v1")
env.reset(seed=0)
env.step(env.action_space.sample())
many = gymnasium.make_vec("tailgate:tailgate/CarFollowing-v1", num_envs=256, autoreset="same_step")
many.reset(seed=0)
many.step(many.action_space.sample())
assert many.engine == "traced", many.engine_why
heavy = [name for name in ("torch", "stable_baselines3", "cvxpy", "matplotlib.pyplot") if name in sys.modules]
assert not heavy and find_spec("torch") is None, f"the light install brings or loads {heavy or 'torch'}"
assert {"LICENSE", "LICENSE-Apache-2.0", "NOTICE"} <= {path.name for path in files("tailgate") or () if "licenses" in path.parts}
P

for python in "$@"; do
  found=$(version "$python") then=$(date +%s)
  [ -n "$found" ] || { echo "$python: no Python from 3.11 on" >&2; exit 1; }
  for what in sdist wheel; do
    rm -rf "$work/env" "$work/play"
    "$python" -m venv "$work/env"
    mkdir "$work/play"
    bin=$work/env/bin
    eval install "$bin/python" "\$$what"
    stage "$what installed"
    (
      cd "$work/play"
      "$bin/python" "$work/first.py"
      quiet "$bin/tailgate" list defences
      quiet "$bin/tailgate" evaluate --suite quick-v0 --scenario gusty-stop-and-go-v0 --seeds 5 --defence kf --attack none --out rows.jsonl
      quiet "$bin/tailgate" leaderboard build --rows rows.jsonl --out page
      test -s page/index.html
      quiet "$bin/python" -m tailgate.evaluation.golden --check --scenario stop-and-go-v0 --scenario radar-following-v0
    )
    stage "$what played"
  done
  [ -z "${LIGHT:-}" ] || continue
  install "$bin/python" "$wheel[train]"
  stage "extra train installed"
  (
    cd "$work/play"
    quiet "$bin/tailgate" train steps=1000
    quiet "$bin/tailgate" train --config gusty steps=1280 'ppo={envs: 16, rollout: 40, batch_size: 160, epochs: 1}' episodes=12 \
      "rivals=['fdi:trigger=near,threshold=30']" 'others=[]' 'white_box=[]' name=ppo
  )
  stage "trained"
  "$bin/python" -m pip install --quiet --constraint constraints.txt pytest pytest-xdist hypothesis
  "$bin/python" -m pytest -p no:cacheprovider -W ignore -n "${JOBS:-1}" tests/test_engine.py tests/test_traced.py tests/test_registry.py \
    tests/test_faces.py tests/test_packaging.py
  "$bin/python" -m pytest -p no:cacheprovider -W ignore -n "${JOBS:-1}" tests/test_golden.py -k "quick or radar or platoon"
  stage "tests"
done
