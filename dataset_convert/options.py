"""The options of `lansar-convert`."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from dataset_convert.blocks import BLOCK_ORDERS
from dataset_convert.calvin import CalvinSplit
from dataset_convert.episodes import DEDUP, MODES
from dataset_convert.language import LANG_FOLDER
from dataset_convert.layout import FORMAT, RGBEncoder
from lerobot_lansar.calvin import CONTROL_MODES
from lerobot_lansar.clip.config import ClipConfig
from lerobot_lansar.datasets import dataset_folder
from lerobot_lansar.jobs.executors import check_executor
from lerobot_lansar.jobs.work import SlurmConfig
from lerobot_lansar.pictures import check_size

IMAGES = ("video", "png", "none")


@dataclass
class ConvertConfig:
    """Converts a split of a CALVIN dataset to a LeRobotDataset v3 at 30 fps."""

    # Folder of the CALVIN dataset, the one that holds training/ and validation/.
    root: Path
    # Name of the dataset, you/name; also its name on the hub.
    repo_id: str
    # Folder to create; by default where LeRobot looks for a dataset of that name.
    output_dir: Path | None = None
    # Split to convert: training or validation.
    split: str = "training"
    # Scene that all of the split was recorded in, if no file says it; validation/ is D unless one does.
    scene: str = ""
    # The split's folder with auto_lang_ann.npy, such as lang_paraphrase-MiniLM-L3-v2.
    lang_folder: str = LANG_FOLDER
    # Keep the sentence embeddings of that folder beside the data.
    lang_embeddings: bool = False
    # windows: one episode per annotated window; play: one per uninterrupted recording, in which the annotated windows
    # give frames their command.
    mode: str = "windows"
    # Overlapping windows to leave out: none, those of the same task (task), or all (frames).
    dedup: str = "none"
    # Leave out of training whatever contains frames that are in validation too.
    exclude_shared: bool = False
    # Leave out defective episodes and list them, instead of stopping at the first.
    skip_bad: bool = False
    # Order of the blocks in scene_obs. checked: that of the scene, and an error if lifts or doors contradict it; known:
    # that of the scene in any case; lifts: the one that the lifts show.
    block_order: str = "checked"
    # What `action` holds: rel (relative) or abs (absolute); the other form is kept in another column.
    action: str = "rel"
    # Store the simulator's own state of the scene, privileged, in observation.environment_state. Without, policies that
    # read whatever there is (ACT, Diffusion) know the blocks from pictures only.
    scene_state: bool = True
    # Tell policies that read no language which task is commanded: 34 more numbers in observation.environment_state,
    # 1 for the commanded task and 0 for the others.
    task_in_state: bool = False
    # Write complementary_info.is_intervention, who acted, although the frames do not say it: the demonstrator always.
    # Recordings of takeovers say it and always have it, and LeRobot merges datasets only if all or none do.
    is_intervention: bool = False
    # How both cameras are stored: video, png (in the parquet files) or none.
    images: str = "video"
    # Width and height of both cameras' pictures and depth, as in --env.image_size; 0: 200 and 84, the cameras' own.
    image_size: int = 0
    # Store poses and intrinsics of both cameras as observations too, as --env.camera_poses gives them.
    camera_poses: bool = False
    # Store both cameras' depth (m) too.
    depth: bool = False
    # Store the pictures of the fingertip sensors too.
    tactile: bool = False
    # How videos are encoded, in LeRobot's terms.
    rgb_encoder: RGBEncoder = field(default_factory=RGBEncoder)
    # Compute CLIP embeddings of the pictures and store them beside the data.
    embed: bool = False
    # Which CLIP computes the embeddings.
    clip: ClipConfig = field(default_factory=ClipConfig)
    # Processes that convert in parallel.
    workers: int = 1
    # Where they run: local, slurm or ray.
    executor: str = "local"
    # How jobs are submitted with --executor=slurm.
    slurm: SlurmConfig = field(default_factory=SlurmConfig)
    # License of the data for the dataset's card, by the hub's name for it; CALVIN's is mit.
    license: str = "mit"
    # Upload to the hub when done.
    push_to_hub: bool = False
    # Make the uploaded dataset private.
    private: bool = False

    @property
    def target(self) -> Path:
        """The folder to create."""
        return dataset_folder(self.repo_id, self.output_dir)

    def check(self) -> None:
        """Raises ValueError at an impossible option."""
        for name, choices in (
            ("action", CONTROL_MODES),
            ("mode", MODES),
            ("dedup", DEDUP),
            ("images", IMAGES),
            ("block_order", BLOCK_ORDERS),
        ):
            if getattr(self, name) not in choices:
                raise ValueError(f"--{name}={getattr(self, name)}: expected {' or '.join(choices)}")
        if self.mode == "play" and self.dedup != "none":
            raise ValueError("--dedup needs --mode=windows: in play every frame occurs once")
        if self.images == "none" and (self.depth or self.tactile or self.camera_poses):
            raise ValueError("--images=none excludes --depth, --tactile and --camera_poses")
        if self.clip != ClipConfig() and not self.embed:
            raise ValueError("--clip.model and --clip.pretrained need --embed=true: nothing is embedded without it")
        if self.rgb_encoder != RGBEncoder() and self.images != "video":
            raise ValueError(f"--rgb_encoder needs --images=video, not {self.images}: nothing is encoded without it")
        check_size("--image_size", self.image_size)
        if self.images == "video" and 0 < self.image_size < 16:
            raise ValueError(f"--image_size={self.image_size}: videos need 16 pixels or more; --images=png takes any")
        if self.exclude_shared and self.split != "training":
            raise ValueError(f"--exclude_shared needs --split=training, not {self.split}")
        if self.workers < 1:
            raise ValueError(f"--workers={self.workers}: expected 1 or more")
        if self.push_to_hub and self.repo_id.count("/") != 1:
            raise ValueError(f"--repo_id={self.repo_id}: expected user/name to push to the hub")
        if self.private and not self.push_to_hub:
            raise ValueError("--private=true needs --push_to_hub=true: nothing is uploaded without it")
        check_executor(self.executor, self.slurm)

    def open_split(self) -> CalvinSplit:
        """Reads the source's index."""
        return CalvinSplit(
            self.root, self.split, lang_folder=self.lang_folder, scene=self.scene, skip_bad=self.skip_bad
        )

    def request(self, split: CalvinSplit) -> dict[str, Any]:
        """Everything that decides the dataset's frames."""
        names = (
            "split",
            "mode",
            "dedup",
            "exclude_shared",
            "skip_bad",
            "action",
            "images",
            "depth",
            "tactile",
        )
        unusual = {
            name: getattr(self, name)
            for name, usual in (
                ("scene_state", True),
                ("task_in_state", False),
                ("is_intervention", False),
                ("scene", ""),
                ("image_size", 0),
                ("camera_poses", False),
                ("lang_folder", LANG_FOLDER),
                ("lang_embeddings", False),
                ("block_order", "checked"),
            )
            if getattr(self, name) != usual
        }
        return {
            "format": FORMAT,
            "source": self.root.resolve().name,
            "source_sha256": split.source_sha256,
            **{name: getattr(self, name) for name in names},
            "rgb_encoder": asdict(self.rgb_encoder) if self.images == "video" else None,
            **unusual,
        }
