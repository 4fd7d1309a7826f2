"""The text of an uploaded LanSAR's model card."""

from lerobot.configs.train import TrainPipelineConfig

from .configuration_lansar import LanSARConfig

_PRIVILEGED = """**It reads privileged simulator state**: the poses of the three blocks and the state of drawer, slider,
button, switch and lights (`observation.environment_state`). Say so when you compare it with policies that see pictures
only."""
_NOT_PRIVILEGED = "It reads the robot's own state, but neither the poses of the blocks nor the state of the furniture."

_CARD = """# LanSAR on CALVIN's desk

LanSAR (Language-commanded Scene-aware Action Response) is a reactive transformer policy for the
[CALVIN](https://github.com/mees/calvin) desk. 30 times a second it reads {inputs} and the command as a CLIP embedding.
It predicts the gripper's next motion from the last {window} steps at most.

{privileged}

## Use

[LeRobot](https://github.com/huggingface/lerobot) finds this policy and the desk only if their plugin is installed, the
distribution `lerobot_policy_lansar`: see its installation page.

```bash
lerobot-eval --policy.path={repo_id} --env.type=calvin --env.control_mode={control_mode}{cameras} \\
    --eval.n_episodes=1000 --eval.batch_size=10 --seed=0
```

These are the 1000 chains of CALVIN's long-horizon benchmark; `--env.task=open_drawer` evaluates a single task, for
example. The policy needs observations in CALVIN's conventions, as `lansar-convert` writes them and this environment
gives them.

## Training

{training}
"""


def card_text(config: LanSARConfig, run: TrainPipelineConfig | None) -> str:
    """The card's Markdown.

    Args:
        config: The policy's options.
        run: Those of the training; None if unknown.
    """
    inputs = "the state of robot, blocks and furniture" if config.use_spatial_context else "the state of the robot"
    if config.use_images:
        inputs += ", two pictures as embeddings by " + ("its own image encoder" if config.finetune_clip else "CLIP")
    facts = {"CLIP": f"{config.clip.model} {config.clip.pretrained}", "learning rate": config.learning_rate}
    if run is not None:
        dataset = run.dataset.repo_id
        facts |= {
            "dataset": f"[{dataset}](https://huggingface.co/datasets/{dataset})",
            "updates": run.steps,
            "windows per update": run.batch_size,
            "seed": run.seed,
        }
    return _CARD.format(
        inputs=inputs,
        window=config.window,
        privileged=_PRIVILEGED if config.use_spatial_context else _NOT_PRIVILEGED,
        repo_id=config.repo_id or "DIR",
        control_mode=config.control_mode,
        cameras="" if config.use_images else " --env.cameras='[]'",
        training="\n".join(["| | |", "| --- | --- |", *(f"| {name} | {value} |" for name, value in facts.items())]),
    )
