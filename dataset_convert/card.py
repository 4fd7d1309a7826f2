"""The dataset's card: its README.md, shown on the Hugging Face hub."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from dataset_convert.language import EMBEDDINGS, LANG_FOLDER, embeddings_name
from dataset_convert.poses import GRIPPER_POSE
from lerobot_lansar.calvin import CAMERAS, COLORS
from lerobot_lansar.datasets import INTERVENTION_FEATURE, MANIFEST

_REL = "pose difference to the TCP's in units of (0.02 m, 0.05 rad), clipped to ±1; gripper −1 close, +1 open"
_ABS = "TCP position (m) and euler angles (rad) in the world frame; gripper −1 close, +1 open"
_ACTION = {"rel": _REL, "abs": _ABS}

_MEANING = {
    "observation.state": "`robot_obs`: TCP pose (m, rad), gripper width (m), 7 joints (rad), gripper action",
    "calvin.actions": f"the same action in absolute form: {_ABS}",
    "calvin.rel_actions": f"the same action in relative form: {_REL}",
    "calvin.frame": "frame number in the source",
    "calvin.window": "annotated window that the frame belongs to (its place in the language file), −1 for none",
    "calvin.task": f"CALVIN task, a place in `task_names` of `{MANIFEST}`, −1 for none",
    "calvin.scene": f"scene, a place in `scene_names` of `{MANIFEST}`",
    INTERVENTION_FEATURE: "who acted: true for the demonstrator, false for a policy",
    "observation.images.static": "fixed camera",
    "observation.images.gripper": "camera in the hand",
    "observation.images.static_depth": "distances (m) of the fixed camera",
    "observation.images.gripper_depth": "distances (m) of the camera in the hand",
    GRIPPER_POSE: "4×4 pose of the camera in the hand, camera to world (m)",
    **{f"observation.camera_pose.{camera}": "4×4 pose, camera to world (m)" for camera in CAMERAS},
    **{f"observation.camera_intrinsics.{camera}": "3×3 intrinsics (pixels)" for camera in CAMERAS},
}

_SCENE = "`scene_obs`: slider, drawer, button, switch, bulb, LED; red, blue, pink block"
_TASK = "1 for the commanded task, 0 for the others (`names` of `meta/info.json`)"


def write(root: Path, repo_id: str) -> None:
    """Writes README.md."""
    # Takes seconds, and worker processes import this module.
    from lerobot.datasets.io_utils import load_info
    from lerobot.datasets.utils import create_lerobot_dataset_card

    card = create_lerobot_dataset_card(dataset_info=load_info(root), repo_id=repo_id, **fields(root, repo_id))
    # In a hub download README.md is a link into the cache: writing would follow the link, renaming replaces it.
    partial = root / ".README.md.partial"
    card.save(partial)
    partial.rename(root / "README.md")


def fields(root: Path, repo_id: str) -> dict[str, Any]:
    """The variables that LeRobot's template of a card takes, for a converted dataset."""
    manifest = json.loads((root / MANIFEST).read_text())
    info = json.loads((root / "meta" / "info.json").read_text())
    clip = root / "clip" / "clip.json"
    return {
        "tags": ["calvin", "language-conditioned"],
        "license": manifest["license"] or None,
        "dataset_description": describe(
            manifest, info, json.loads(clip.read_text()) if clip.exists() else None, repo_id
        ),
        "url": "http://calvin.cs.uni-freiburg.de",
        "paper": "https://arxiv.org/abs/2112.03227",
    }


def describe(manifest: dict[str, Any], info: dict[str, Any], clip: dict[str, Any] | None, repo_id: str) -> str:
    """The description part of the card.

    Args:
        manifest: What the file `MANIFEST` holds.
        info: What `meta/info.json` holds.
        clip: What `clip/clip.json` holds, if there are embeddings.
        repo_id: The dataset's name.

    Returns:
        Markdown.
    """
    request = manifest["request"]
    used = [manifest["windows"][number] for episode in manifest["episodes"] for number in episode["windows"]]
    counts = Counter(window["task"] for window in used)
    tasks = "\n".join(f"| {task} | {counts[task]} |" for task in manifest["task_names"] if counts[task])
    scenes = "; ".join(
        f"{letter} (in the source's order {', '.join(scene['block_order'])})"
        for letter, scene in manifest["scenes"].items()
    )
    episode = (
        "one per annotated window"
        if request["mode"] == "windows"
        else "one per uninterrupted recording of play, in which the annotated windows give a frame its task"
    )
    hours = info["total_frames"] / info["fps"] / 3600
    return f"""Demonstrations on the CALVIN desk (Mees et al., 2022): {info["total_episodes"]} episodes, {episode};
{info["total_frames"]} frames ({hours:.1f} hours) at {info["fps"]} Hz, {info["total_tasks"]} different commands.

| feature | shape | stored as | content |
| --- | --- | --- | --- |
{_features(info, request)}

* **Source:** split `{request["split"]}` of `{request["source"]}`, SHA-256 of its index files
  `{request["source_sha256"]}`, converted with lerobot_policy_lansar {manifest["versions"]["lerobot_policy_lansar"]}.
  Every frame was checked: finite, of the right shape and type, relative actions equal to what absolute actions and
  states imply, no frame missing. `{MANIFEST}` has a SHA-256 of every episode's source frames and of every
  file in `data`, `videos` and `meta` but itself; `lansar-verify` compares this dataset with its source.
* **Angles** of states and absolute actions: roll in [0, 2π), pitch in [−π, π), yaw in [−π/2, 3π/2), so that no pose
  that the arm reaches jumps. CALVIN's own roll jumps between π and −π, where a hand that points down has it.
* **Windows** end before their last number, as in CALVIN.{_windows(manifest, used)}
* **Scenes:** {scenes}; known from {manifest["scenes_from"]}. Blocks are always red, blue, pink here.
{_look(manifest)}{_privileged(request)}
{_clip(clip)}{_lang(request)}
| task | windows |
| --- | ---: |
{tasks}

### Known defects

{_defects(manifest)}

### Train and evaluate

With LeRobot and the plugin lerobot_policy_lansar installed beside it:

{_commands(request, manifest["look"]["image_size"], clip, repo_id)}
"""


def _features(info: dict[str, Any], request: dict[str, Any]) -> str:
    rows = []
    for key, feature in info["features"].items():
        if not key.startswith(("observation.", "action", "calvin.", "complementary_info.")):
            continue
        shape = "×".join(str(size) for size in feature["shape"])
        text = _ACTION[request["action"]] if key == "action" else _MEANING.get(key, "fingertip sensor")
        if key == "observation.environment_state":
            has = {_SCENE: request.get("scene_state", True), _TASK: request.get("task_in_state", False)}
            text = "; then ".join(part for part, there in has.items() if there)
        rows.append(f"| `{key}` | {shape} | {feature['dtype']} | {text} |")
    return "\n".join(rows)


def _privileged(request: dict[str, Any]) -> str:
    if not request.get("scene_state", True):
        return "* **Privileged state:** none: the scene's state was left out (`--scene_state=false`)."
    return """* **Privileged state:** `observation.environment_state` is the simulator's own state (block poses,
  joints, lights). A real robot does not have it; results of policies that read it must say so."""


def _look(manifest: dict[str, Any]) -> str:
    """The look of the pictures, and where the cameras are."""
    look, cameras = manifest["look"], manifest["cameras"]
    if not cameras:
        return ""
    drawn = f"renderer `{look['renderer'] or 'unknown'}`, {look['assets'] or 'unknown'} assets"
    if (look["renderer"], look["assets"]) == ("gl", "original"):
        drawn += ", as in CALVIN's public data"
    size = f", both cameras brought to {look['image_size']} pixels" if look["image_size"] else ""
    return f"""* **Pictures:** {drawn}{size}. Evaluate in the same look (`--env.renderer`, `--env.assets`,
  `--env.image_size`).
* **Cameras:** intrinsics of both and the static camera's pose are in `cameras` of `{MANIFEST}`, the gripper camera's
  pose in `{GRIPPER_POSE}`. The convention is OpenCV's (x right, y down, z forward; camera to world, m; row by row).
"""


def _windows(manifest: dict[str, Any], used: list[dict[str, Any]]) -> str:
    request = manifest["request"]
    kept = "" if len(used) == len(manifest["windows"]) else f" {len(used)} of {len(manifest['windows'])} are here."
    if request["mode"] == "play":
        return f"{kept} Every frame of play is here once."
    if request["dedup"] == "none":
        return f"{kept} Windows may overlap: in the public data they are random cuts around a solved task."
    what = "of one task " if request["dedup"] == "task" else ""
    return f"{kept} No two windows {what}share a frame (`--dedup={request['dedup']}`)."


def _defects(manifest: dict[str, Any]) -> str:
    return "\n".join(f"* {text}" for text in (_shared(manifest), _colors(manifest), _left_out(manifest)))


def _shared(manifest: dict[str, Any]) -> str:
    shared = manifest["shared_frames"]
    if manifest["request"]["split"] != "training":
        return "**Frames in both splits:** the card of the training split lists them."
    if not shared:
        return "**Frames in both splits:** none found (they are looked for if `training/` and `validation/` are there)."
    here = sum(any(e["start"] <= frame < e["end"] for e in manifest["episodes"]) for frame in shared)
    frames = ", ".join(map(str, shared[:10])) + (f" and {len(shared) - 10} more" if len(shared) > 10 else "")
    return f"**Frames in both splits:** training and validation share {frames}; in episodes here: {here or 'none'}."


def _colors(manifest: dict[str, Any]) -> str:
    """What the lifting windows say: the block that rises should be the one that the task names."""
    total, wrong, wrongs = 0, 0, []
    for letter, scene in manifest["scenes"].items():
        votes = np.array(manifest["block_votes"][letter])
        total += int(votes.sum())
        for named, row in zip(COLORS, votes.tolist(), strict=True):
            for risen, count in zip(scene["block_order"], row, strict=True):
                if count and risen != named:
                    wrong += count
                    wrongs.append(f"{count} × {risen} instead of {named} in scene {letter}")
    found = f"except in {wrong} ({', '.join(wrongs)}), which are here as annotated" if wrong else "in all"
    against = manifest["contradictions"]
    if against:
        what = "; ".join(f"scene {scene}: {'; '.join(texts)}" for scene, texts in against.items())
        option = f"--block_order={manifest['request']['block_order']}"
        return (
            f"**Colours or scenes are wrong:** {what}. Converted all the same, with `{option}`: do not trust the "
            "colours of blocks, in commands or in `observation.environment_state`."
        )
    if not total:
        return "**Wrong colours:** unknown: no annotated window lifts a block, which is what would show them."
    return (
        f"**Wrong colours:** {total} annotated windows of the split lift a block, by `scene_obs`. It is the one that "
        f"the task names {found}. Other tasks than `lift_…` were not examined."
    )


def _left_out(manifest: dict[str, Any]) -> str:
    bad = manifest["left_out"]
    if not bad:
        return "**Left out:** no defective episode."
    first = "; ".join(f"frames {e['start']}-{e['end'] - 1}: {e['reason']}" for e in bad[:5])
    return (
        f"**Left out:** {len(bad)} defective episodes, all in `left_out` of `{MANIFEST}` "
        f"({first}{'; …' if len(bad) > 5 else ''})."
    )


def _clip(clip: dict[str, Any] | None) -> str:
    if clip is None:
        return ""
    return (
        f"* **CLIP embeddings** of both cameras' pictures: `clip/*.npy`, float16 by absolute `index`, of open_clip's\n"
        f"  {clip['model']} {clip['pretrained'] or 'untrained'}, SHA-256 of its weights `{clip['weights_sha256']}`;\n"
        "  `clip/clip.json` has a SHA-256 of both arrays.\n"
    )


def _lang(request: dict[str, Any]) -> str:
    if not request.get("lang_embeddings"):
        return ""
    folder = request.get("lang_folder", LANG_FOLDER)
    file = f"{EMBEDDINGS}/{embeddings_name(folder)}.npy"
    return (
        f"* **Sentence embeddings** of the source's `{folder}`: `{file}`, float32,\n"
        "  a row per window (`calvin.window`); the `.json` beside it names the encoder.\n"
    )


def _commands(request: dict[str, Any], size: int, clip: dict[str, Any] | None, repo_id: str) -> str:
    scene = "" if request.get("scene_state", True) else " --env.scene_state=false"
    seen = f" --env.image_size={size}" if size else ""  # the pictures' own size: the recording may have had it already
    cameras = " --env.cameras='[]'" if request["images"] == "none" else seen
    cameras += " --env.depth=true" if request["depth"] else ""
    cameras += " --env.camera_poses=true" if request.get("camera_poses") else ""
    if request.get("task_in_state"):  # for policies that read no language; LanSAR refuses such a dataset
        act = "act_depth" if request["depth"] else "act"
        return f"""    lerobot-train --policy.type={act} --policy.push_to_hub=false \\
        --dataset.repo_id={repo_id} --output_dir=outputs/train
    lerobot-eval --policy.path=outputs/train/checkpoints/last/pretrained_model --env.type=calvin \\
        --env.control_mode={request["action"]} --env.task_in_state=true{scene}{cameras}"""
    if request["mode"] == "play":
        return f"""    lerobot-train --policy.type=… --policy.push_to_hub=false \\
        --dataset.repo_id={repo_id} --output_dir=outputs/train

for a policy that reads one frame's command at a time. LanSAR learns demonstrations of one command each and refuses
this dataset; convert with `--mode=windows` for it."""
    if scene and clip is None:
        return f"""    lerobot-train --policy.type=… --policy.push_to_hub=false \\
        --dataset.repo_id={repo_id} --output_dir=outputs/train
    lerobot-eval --policy.path=outputs/train/checkpoints/last/pretrained_model --env.type=calvin \\
        --env.control_mode={request["action"]}{scene}{cameras}

for a policy that reads language{"" if request["images"] == "none" else " and pictures"}. LanSAR needs embeddings of the
pictures (`--embed=true`, or `lansar-embed`) and `--policy.use_spatial_context=false`."""
    train, evaluate = " --policy.use_images=false", " --env.cameras='[]'"
    if clip is not None:
        train = f" --policy.clip.model={clip['model']} --policy.clip.pretrained={clip['pretrained']}"
        train += " --policy.use_spatial_context=false" if scene else ""
        evaluate = scene + seen
    return f"""    lerobot-train --policy.type=lansar{train} --policy.push_to_hub=false \\
        --dataset.repo_id={repo_id} --output_dir=outputs/train
    lerobot-eval --policy.path=outputs/train/checkpoints/last/pretrained_model --env.type=calvin \\
        --env.control_mode=abs{evaluate}

LanSAR emits absolute poses by default; a policy that emits what `action` holds is evaluated with
`--env.control_mode={request["action"]}`."""
