"""The thesis' learning-rate schedule as a LeRobot scheduler (Table 4.2, section 4.2)."""

from dataclasses import dataclass

from lerobot.optim.schedulers import LRSchedulerConfig
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR


@LRSchedulerConfig.register_subclass("linear_warmup_decay")
@dataclass
class LinearWarmupDecaySchedulerConfig(LRSchedulerConfig):
    """Linear warm-up to the optimizer's learning rate, then linear decay to 0 at the last update."""

    # Updates of warm-up; None means warmup_fraction of the run.
    num_warmup_steps: int | None = None
    # Share of the updates in which the learning rate rises; 5 of 125 epochs in the thesis.
    warmup_fraction: float = 0.04

    def build(self, optimizer: Optimizer, num_training_steps: int) -> LambdaLR:
        total = max(num_training_steps, 1)
        warmup = self.num_warmup_steps
        if warmup is None:
            warmup = round(self.warmup_fraction * total)

        def factor(step: int) -> float:
            """1 / (warmup + 1) at update 0, 1 at update `warmup`, 0 after the last update."""
            rise = (step + 1) / (warmup + 1)
            fall = (total - step) / max(total - warmup, 1)
            return max(0.0, min(rise, fall, 1.0))

        return LambdaLR(optimizer, factor)
