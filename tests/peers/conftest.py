"""A hand-made LeRobotDataset with pictures, and small MCILs, HULCs and GR-1s."""

from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_lansar.calvin import ACTION_NAMES

torch.set_num_threads(1)

SIZE = 40  # pixels, both cameras
LENGTH = 24
COLORS = {"red": (220, 40, 40), "blue": (40, 60, 220)}
CLIP = {"clip.model": "lansar-desk", "clip.pretrained": "v1"}
LATENT_PLAN = {
    "static_size": SIZE,
    "gripper_size": 36,
    "static_shift": 2,
    "gripper_shift": 1,
    "visual_features": 16,
    "goal_features": 16,
    "hidden": 96,
    "plan_size": 8,
    "window": 16,
    "min_window": 8,
    "replan_steps": 5,
    **CLIP,
}
SMALL = {
    "mcil": {**LATENT_PLAN, "static_shift": 0, "gripper_shift": 0},
    "hulc": {**LATENT_PLAN, "plan_classes": 8, "recognition_heads": 2, "recognition_features": 96},
    "gr1": {
        "image_encoder": "test_vit",
        "image_size": 48,
        "static_shift": 2,
        "gripper_shift": 1,
        "hidden": 96,
        "layers": 2,
        "heads": 4,
        "picture_heads": 4,
        "picture_layers": 1,
        "resampler_layers": 1,
        "resampler_head_size": 16,
        "patch_tokens": 3,
        "window": 6,
        "warmup_steps": 5,
        **CLIP,
    },
}
FORMS = {"mcil": "abs", "hulc": "rel", "gr1": "rel"}


def demonstration(rng: np.random.Generator, color: str) -> dict[str, np.ndarray]:
    """The hand goes to the square of one colour, closing when it is there.

    Pictures show both squares and, black, the hand; the ground has another colour in each demonstration.
    """
    places = {name: rng.uniform(-0.15, 0.15, 2) for name in COLORS}
    state = np.zeros((LENGTH, 15), np.float32)
    state[0, :6] = [*rng.uniform(-0.15, 0.15, 2), 0.5, np.pi, 0, 1.5]
    state[:, 14] = 1
    absolute = np.zeros((LENGTH, 7), np.float32)
    for t in range(LENGTH):
        way = places[color] - state[t, :2]
        step = np.clip(way, -0.02, 0.02)
        absolute[t] = [*(state[t, :2] + step), *state[t, 2:6], -1 if np.abs(way).max() < 0.005 else 1]
        if t + 1 < LENGTH:
            state[t + 1, :6], state[t + 1, 14] = absolute[t, :6], absolute[t, 6]
    relative = np.concatenate([(absolute[:, :6] - state[:, :6]) / ([0.02] * 3 + [0.05] * 3), absolute[:, 6:]], axis=1)
    pictures = np.broadcast_to(rng.integers(0, 256, 3, np.uint8), (LENGTH, SIZE, SIZE, 3)).copy()
    for t in range(LENGTH):
        for place, shade in (*((places[name], COLORS[name]) for name in COLORS), (state[t, :2], (0, 0, 0))):
            x, y = (np.asarray(place) / 0.4 * SIZE + SIZE / 2).astype(int)
            pictures[t, max(y - 5, 0) : y + 5, max(x - 5, 0) : x + 5] = shade
    return {"state": state, "abs": absolute, "rel": relative.astype(np.float32), "pictures": pictures}


def make_dataset(
    root: Path, form: str, count: int, unlabelled: int = 0, sentences: list[str] | None = None, camera: str = "static"
) -> None:
    """Writes `count` demonstrations with commands and `unlabelled` without, as one LeRobotDataset.

    With `sentences`, each frame of a demonstration has its own; `camera` is the static camera's name.
    """
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from lerobot_lansar.datasets import NO_COMMAND

    picture = {"dtype": "image", "shape": (SIZE, SIZE, 3), "names": ["height", "width", "channels"]}
    features = {
        "observation.state": {"dtype": "float32", "shape": (15,), "names": None},
        "observation.environment_state": {"dtype": "float32", "shape": (24,), "names": None},
        "action": {"dtype": "float32", "shape": (7,), "names": ACTION_NAMES[form]},
        f"observation.images.{camera}": picture,
        "observation.images.gripper": picture,
    }
    dataset = LeRobotDataset.create("test/squares", fps=30, features=features, root=root, use_videos=False)
    rng = np.random.default_rng(0)
    for i in range(count + unlabelled):
        color = list(COLORS)[i % 2]
        shown = demonstration(rng, color)
        for t in range(LENGTH):
            frame = {
                "observation.state": shown["state"][t],
                "observation.environment_state": np.zeros(24, np.float32),
                "action": shown[form][t],
                f"observation.images.{camera}": shown["pictures"][t],
                "observation.images.gripper": shown["pictures"][t],
                "task": sentences[t] if sentences else f"lift the {color} block" if i < count else NO_COMMAND,
            }
            dataset.add_frame(frame)
        dataset.save_episode()
    dataset.finalize()


@pytest.fixture(scope="session")
def datasets(tmp_path_factory):
    """Form of the actions to a dataset's folder: 32 demonstrations; read-only."""
    folder = tmp_path_factory.mktemp("squares")
    for form in ("rel", "abs"):
        make_dataset(folder / form, form, 32)
    return {form: folder / form for form in ("rel", "abs")}


def make(kind: str, dataset_meta=None, **options):
    """A small policy and its pipelines; without a dataset, statistics as if all poses lay in ±4."""
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.factory import get_policy_class, make_policy_config, make_pre_post_processors

    import lerobot_policy_lansar  # noqa: F401
    from lerobot_lansar.clip.config import ClipConfig

    options = {k: v for k, v in {**SMALL[kind], **options}.items() if not k.startswith("clip.")}
    inputs = {
        f"observation.images.{c}": PolicyFeature(FeatureType.VISUAL, (3, SIZE, SIZE)) for c in ("static", "gripper")
    }
    inputs["observation.state"] = PolicyFeature(FeatureType.STATE, (15,))
    config = make_policy_config(
        kind,
        device="cpu",
        clip=ClipConfig("lansar-desk", "v1"),
        input_features=inputs,
        output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))},
        **options,
    )
    torch.manual_seed(0)
    policy = get_policy_class(kind)(config, dataset_meta=dataset_meta)
    stats = {"action": {"min": np.full(7, -4.0, np.float32), "max": np.full(7, 4.0, np.float32)}}
    stats["action"]["min"][6], stats["action"]["max"][6] = -1, 1
    return policy, *make_pre_post_processors(config, dataset_stats=dataset_meta.stats if dataset_meta else stats)
