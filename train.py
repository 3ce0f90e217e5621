"""python train.py [--config FILE] [key=value ...]: train an adversary."""

import sys

from tailgate.cli import main

if __name__ == "__main__":
    raise SystemExit(main(["train", *sys.argv[1:]]))
