"""LanSAR as a LeRobot policy: importing this package registers `--policy.type=lansar`.

configuration_lansar  LanSARConfig: every option
modeling_lansar       LanSARPolicy: the loss in training, one action per control step at inference
network               LanSARNetwork: the neural network alone, tensors in and out
cache                 the decoder's key-value cache
scaling               observations and motions to numbers of order one, and back
processor_lansar      LeRobot pipeline steps: training windows, CLIP embeddings
windows               which steps of which demonstration a sampled frame stands for
frames                a dataset's frames as memory-mapped arrays
scheduler             the learning rate over a run
optimizer             Muon
card                  the text of an uploaded policy's model card

LeRobot rebuilds a checkpoint's pipelines, optimizer and scheduler by their registered names, so these are imported
here. It imports the model itself when it builds one.
"""

from .configuration_lansar import LanSARConfig
from .optimizer import MuonConfig
from .processor_lansar import ClipStep, WindowStep, make_lansar_pre_post_processors
from .scheduler import LinearWarmupDecaySchedulerConfig

__all__ = [
    "ClipStep",
    "LanSARConfig",
    "LinearWarmupDecaySchedulerConfig",
    "MuonConfig",
    "WindowStep",
    "make_lansar_pre_post_processors",
]
