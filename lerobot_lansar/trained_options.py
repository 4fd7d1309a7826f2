"""Options that a checkpoint's weights depend on."""

from collections.abc import Iterable

from lerobot.configs.policies import PreTrainedConfig


def check_trained_options(config: PreTrainedConfig, names: Iterable[str], switches: Iterable[str] = ()) -> None:
    """Rejects options that pretrained weights were not trained with.

    Some would change silently what the weights mean; others would fail later, with a message about shapes.

    Args:
        config: The policy's options; without `pretrained_path` there is nothing to check.
        names: Those that must stay as the checkpoint was trained.
        switches: Those that must stay 0 or must not become 0.

    Raises:
        ValueError: One of them is not that of the checkpoint.
    """
    if not config.pretrained_path:
        return
    trained = PreTrainedConfig.from_pretrained(config.pretrained_path, revision=config.pretrained_revision)
    for name in (*names, *switches):
        given, expected = getattr(config, name), getattr(trained, name)
        if bool(given) != bool(expected) if name in switches else given != expected:
            raise ValueError(
                f"--policy.{name}={given}: {config.pretrained_path} was trained with {name}={expected}, on which its "
                "weights depend. Omit the option, or train a new policy."
            )
