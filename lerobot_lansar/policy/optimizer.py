"""Muon as a LeRobot optimizer, `--policy.optimizer=muon` or `--optimizer.type=muon`."""

from dataclasses import asdict, dataclass
from typing import Any

import torch
from lerobot.optim import OptimizerConfig
from torch import Tensor, nn
from torch.optim import AdamW, Optimizer

MATRICES = "matrices"
"""Name of the parameter group that Muon updates; AdamW updates all others."""


@OptimizerConfig.register_subclass("muon")
@dataclass
class MuonConfig(OptimizerConfig):
    """Muon for matrices and AdamW for everything else, with one learning rate for both.

    Muon's updates are scaled to the size of AdamW's ("match_rms_adamw" of `torch.optim.Muon`), so a learning rate means
    about the same to both.
    """

    # Peak learning rate.
    lr: float = 3e-3
    # Weight decay.
    weight_decay: float = 0.01
    # Share of the last momentum that Muon keeps in every update.
    momentum: float = 0.95
    # AdamW's.
    betas: tuple[float, float] = (0.9, 0.999)
    # AdamW's.
    eps: float = 1e-8
    # Gradients are clipped to this norm.
    grad_clip_norm: float = 10.0

    def build(self, params: Any) -> "Muon":
        """Builds the optimizer.

        Args:
            params: Parameter groups, of which Muon updates the one named `MATRICES` (see `parameter_groups`); or
                parameters, of which Muon updates all with two dimensions.
        """
        groups = list(params)
        if not groups or not isinstance(groups[0], dict):
            matrices = [p for p in groups if p.ndim == 2]
            groups = [
                {"params": matrices, "name": MATRICES},
                {"params": [p for p in groups if p.ndim != 2], "name": "rest"},
            ]
        options = asdict(self)
        options.pop("grad_clip_norm")
        return Muon([group for group in groups if group["params"]], **options)


def parameter_groups(network: nn.Module) -> list[dict[str, Any]]:
    """A network's parameters for `MuonConfig.build`: the matrices between hidden activations, and the rest.

    Muon is made for matrices that map hidden activations to hidden activations. Embeddings, the first layer of each
    MLP that reads an input and the last layer of each head stay with AdamW, as do norms and biases.
    """
    mlps = [module for module in network.modules() if type(module) is nn.Sequential]
    ends = {id(mlp[-1] if isinstance(mlp[-1], nn.Linear) else mlp[0]) for mlp in mlps}
    linear = [module for module in network.modules() if isinstance(module, nn.Linear)]
    hidden = {id(layer.weight) for layer in linear if id(layer) not in ends}
    parameters = [p for p in network.parameters() if p.requires_grad]
    return [
        {"params": [p for p in parameters if id(p) in hidden], "name": MATRICES},
        {"params": [p for p in parameters if id(p) not in hidden], "name": "rest"},
    ]


class BatchedMuon(torch.optim.Muon):
    """`torch.optim.Muon`, except that matrices of one shape are orthogonalised together.

    A transformer has many matrices and few shapes: a GPU then gets a handful of large products instead of thousands of
    small ones. Up to the rounding of bfloat16, the results are the same. Only its Nesterov form and the scaling
    "match_rms_adamw" are here.
    """

    @torch.no_grad()
    def step(self, closure: Any = None) -> Tensor | None:  # type: ignore[override]
        """One update. `closure` is not used: `Muon` calls it."""
        for group in self.param_groups:
            parameters = [p for p in group["params"] if p.grad is not None]
            if not parameters:
                continue
            gradients = [p.grad for p in parameters]
            for p in parameters:
                self.state[p].setdefault("momentum_buffer", torch.zeros_like(p))
            momenta = [self.state[p]["momentum_buffer"] for p in parameters]
            torch._foreach_lerp_(momenta, gradients, 1 - group["momentum"])
            updates = torch._foreach_lerp(gradients, momenta, group["momentum"])
            torch._foreach_mul_(parameters, 1 - group["lr"] * group["weight_decay"])
            shapes: dict[torch.Size, list[int]] = {}
            for i, p in enumerate(parameters):
                shapes.setdefault(p.shape, []).append(i)
            for shape, places in shapes.items():
                stacked = torch.stack([updates[i] for i in places])
                steps = orthogonalise(stacked, group["ns_coefficients"], group["ns_steps"], group["eps"])
                size = 0.2 * max(shape) ** 0.5  # of AdamW's updates
                torch._foreach_add_(
                    [parameters[i] for i in places], list(steps.to(stacked.dtype)), alpha=-size * group["lr"]
                )
        return None


def orthogonalise(matrices: Tensor, coefficients: tuple[float, float, float], steps: int, eps: float) -> Tensor:
    """The nearest matrices whose singular values are about 1, by Newton and Schulz' iteration in bfloat16.

    Args:
        matrices: (G, rows, columns).
        coefficients: Of a step's odd polynomial.
        steps: How many.
        eps: Least norm that a matrix is divided by.

    Returns:
        (G, rows, columns) bfloat16.
    """
    a, b, c = coefficients
    tall = matrices.shape[1] > matrices.shape[2]
    x = (matrices.mT if tall else matrices).bfloat16()
    x = x / x.norm(dim=(1, 2), keepdim=True).clamp(min=eps)
    for _ in range(steps):
        gram = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return x.mT if tall else x


class Muon(Optimizer):
    """`BatchedMuon` and `torch.optim.AdamW` behind the interface of one optimizer, which LeRobot needs.

    Args:
        groups: Parameter groups; the one named `MATRICES` holds parameters with two dimensions.
        lr, weight_decay: Of both.
        momentum: Muon's.
        betas, eps: AdamW's.
    """

    def __init__(
        self,
        groups: list[dict[str, Any]],
        lr: float,
        weight_decay: float,
        momentum: float,
        betas: tuple[float, float],
        eps: float,
    ) -> None:
        matrices = [group for group in groups if group.get("name") == MATRICES]
        rest = [group for group in groups if group.get("name") != MATRICES]
        self._parts: list[Optimizer] = []
        if matrices:
            muon = BatchedMuon(
                matrices, lr=lr, weight_decay=weight_decay, momentum=momentum, adjust_lr_fn="match_rms_adamw"
            )
            self._parts.append(muon)
        if rest:
            self._parts.append(AdamW(rest, lr=lr, weight_decay=weight_decay, betas=betas, eps=eps))
        super().__init__([group for part in self._parts for group in part.param_groups], {})
        self._share()

    def _share(self) -> None:
        """Makes the parts work on this optimizer's groups and state, which schedulers and checkpoints know."""
        start = 0
        for part in self._parts:
            end = start + len(part.param_groups)
            part.param_groups, part.state = self.param_groups[start:end], self.state
            start = end

    @torch.no_grad()
    def step(self, closure: Any = None) -> Tensor | None:  # type: ignore[override]
        """One update of all parameters."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for part in self._parts:
            part.step()
        return loss

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        super().load_state_dict(state_dict)
        self._share()
