"""The attacker's environments as tensors of PyTorch, and as an environment of TorchRL."""

from tailgate.base.lazy import exported

__getattr__, __all__ = exported(__name__, {"tensors": "TensorVecEnv", "torchrl": "TailgateEnv"})
