"""The dataset's card (README.md), also used on the Hugging Face hub."""

from typing import Any

_REL = "pose difference to the TCP's in units of (0.02 m, 0.05 rad), clipped to ±1; gripper −1 close, +1 open"
_ABS = "TCP position (m) and euler angles (rad) in the world frame; gripper −1 close, +1 open"


def describe(manifest: dict[str, Any], repo_id: str) -> str:
    """The description part of the card.

    Args:
        manifest: what ``meta/calvin_source.json`` holds.
        repo_id: the dataset's name.

    Returns:
        Markdown.
    """
    request = manifest["request"]
    action, other = (_REL, "calvin.actions") if request["action"] == "rel" else (_ABS, "calvin.rel_actions")
    rows = [
        (
            "observation.state",
            "15",
            "`robot_obs`: TCP pose, gripper width (m), 7 joints (rad), gripper action",
        ),
        (
            "observation.environment_state",
            "24",
            "`scene_obs`: slider, drawer, button, switch, bulb, LED, blocks",
        ),
        ("action", "7", action),
        (other, "7", "the same action in the other form"),
        ("calvin.frame", "1", "frame number in the source"),
    ]
    if request["videos"]:
        rows.append(("observation.images.static", "200×200×3", "video of the fixed camera"))
        rows.append(("observation.images.gripper", "84×84×3", "video of the gripper camera"))
    if request["clip"]:
        model = f"{request['clip']['model']} {request['clip']['pretrained']}".strip()
        rows.append(("clip/*.npy", "", f"CLIP embeddings ({model}) of the pictures, by absolute `index`"))
    features = "\n".join(f"| `{key}` | {shape} | {text} |" for key, shape, text in rows)
    scenes = "; ".join(
        f"{letter} (in the source's order {', '.join(scene['block_order'])})"
        for letter, scene in manifest["scenes"].items()
    )
    tasks = sorted({episode["task"] for episode in manifest["episodes"]})
    version = manifest["versions"]["lerobot_policy_lansar"]
    train, evaluate = "", ""
    if request["clip"]:
        clip = request["clip"]
        train = f" --policy.clip.model={clip['model']} --policy.clip.pretrained={clip['pretrained']}"
    else:
        train, evaluate = " --policy.use_images=false", " --env.cameras='[]'"
    return f"""Demonstrations on the CALVIN desk (Mees et al., 2022), one per annotated window, 30 fps.

| feature | shape | content |
| --- | --- | --- |
{features}

* **Source:** split `{request["split"]}` of `{request["source"]}`, SHA-256 of its index files
  `{request["source_sha256"]}`, converted with lerobot_policy_lansar
  {version}. Every frame was checked. Window ends are
  exclusive, as in CALVIN; windows of the public data are random cuts that overlap.
* **Scenes:** {scenes}. Blocks are always red, blue, pink here.
* **Episodes:** {len(manifest["episodes"])}, of {len(tasks)} tasks: {", ".join(tasks)}.
  `meta/calvin_source.json` names each episode's window and task.
* **Privileged state:** `observation.environment_state` is the simulator's own state (block poses, joints,
  lights). A real robot does not have it; results of policies that read it must say so.

Train and evaluate with LeRobot, the plugin lerobot_policy_lansar installed beside it:

    lerobot-train --policy.type=lansar{train} --dataset.repo_id={repo_id} \\
        --output_dir=outputs/train
    lerobot-eval --policy.path=outputs/train/checkpoints/last/pretrained_model --env.type=calvin \\
        --env.control_mode=abs{evaluate}

LanSAR emits absolute poses by default; a policy that emits what `action` holds is evaluated with
`--env.control_mode={request["action"]}`.
"""
