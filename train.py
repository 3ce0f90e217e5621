"""python train.py [--config FILE] [key=value ...]: train an adversary."""

from tailgate.training.train import main

if __name__ == "__main__":
    raise SystemExit(main())
