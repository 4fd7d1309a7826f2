"""GR-1: importing this package registers `--policy.type=gr1`.

configuration_gr1  GR1Config: every option
modeling_gr1       GR1Policy: the loss in training, one action per control step at inference
network            GR1Network: tensors in and out
processor_gr1      the pipelines
"""

from .configuration_gr1 import GR1Config

__all__ = ["GR1Config"]
