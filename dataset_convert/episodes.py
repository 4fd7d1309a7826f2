"""Which frames become an episode: annotated windows, or whole recordings in which windows are annotations."""

from collections.abc import Callable, Container, Iterable
from dataclasses import dataclass

import numpy as np

from dataset_convert.calvin import CalvinSplit
from dataset_convert.language import Window, scene_of

MODES = ("windows", "play")
DEDUP = ("none", "task", "frames")
MAX_FRAMES = 54_000
"""Half an hour: beyond it LeRobot's float32 times no longer find a video's frame to within 0.1 ms."""


@dataclass(frozen=True)
class Span:
    """The source frames of one episode.

    Attributes:
        start: First frame number of the source.
        end: First frame number after it.
        scene: The scene's letter.
        windows: Numbers of the annotated windows inside, in the language file's order.
    """

    start: int
    end: int
    scene: str
    windows: tuple[int, ...]

    def __len__(self) -> int:
        return self.end - self.start


def window_spans(windows: list[Window], dedup: str, excluded: Iterable[int], faults: Container[int] = ()) -> list[Span]:
    """One episode per annotated window, in the language file's order.

    Windows of the public data are random cuts that overlap: on split D every frame occurs 1.58 times.

    Args:
        windows: Of the split.
        dedup: "none" keeps all; "task" keeps as many as possible of which no two show the same task and share
            a frame; "frames" as many as possible of which no two share a frame at all.
        excluded: Frames that no episode may contain.
        faults: Numbers of windows that are left out.
    """
    forbidden = np.unique(np.fromiter(excluded, dtype=np.int64))
    inside = [np.searchsorted(forbidden, w.end) > np.searchsorted(forbidden, w.start) for w in windows]
    numbers = [number for number, is_excluded in enumerate(inside) if not is_excluded and number not in faults]
    if dedup != "none":
        numbers = _without_overlap(windows, numbers, lambda number: windows[number].task if dedup == "task" else None)
    return [Span(windows[n].start, windows[n].end, windows[n].scene, (n,)) for n in numbers]


def _without_overlap(windows: list[Window], numbers: list[int], group: Callable[[int], str | None]) -> list[int]:
    """As many windows as possible of which no two of a group overlap: always takes the one that ends first."""
    free_from: dict[str | None, int] = {}
    chosen = []
    for number in sorted(numbers, key=lambda n: (windows[n].end, -windows[n].start, n)):
        if windows[number].start >= free_from.get(group(number), 0):
            free_from[group(number)] = windows[number].end
            chosen.append(number)
    return sorted(chosen)


def play_spans(split: CalvinSplit, excluded: Iterable[int]) -> list[Span]:
    """One episode per uninterrupted recording with its windows, cut at excluded frames and after `MAX_FRAMES`.

    The scene of an episode that lies in none is "".
    """
    forbidden = sorted(set(excluded))
    starts = np.array([window.start for window in split.windows])
    ends = np.array([window.end for window in split.windows])
    good = ~np.isin(np.arange(len(starts)), list(split.faults))
    spans = []
    for first, last in split.recordings.tolist():
        cuts = [frame for frame in forbidden if first <= frame <= last]
        edges = [first, *(edge for frame in cuts for edge in (frame, frame + 1)), last + 1]
        for start, end in zip(edges[::2], edges[1::2], strict=True):
            while start < end:
                stop = _cut(start, end, starts, ends)
                inside = np.flatnonzero((starts >= start) & (ends <= stop) & good)
                spans.append(Span(start, stop, scene_of(start, stop, split.scenes), tuple(inside.tolist())))
                start = stop
    return spans


def _cut(start: int, end: int, starts: np.ndarray, ends: np.ndarray) -> int:
    """Where an episode that begins at `start` ends; no window is cut in two unless it cannot be avoided."""
    if end - start <= MAX_FRAMES:
        return end
    latest = start + MAX_FRAMES
    near = (ends > latest - 1000) & (starts < latest)
    for stop in range(latest, max(start, latest - 1000), -1):
        if not (near & (starts < stop) & (stop < ends)).any():
            return stop
    return latest


def window_of_frames(span: Span, windows: list[Window]) -> np.ndarray:
    """The window that each frame of an episode belongs to; of several, the one that ends first.

    Returns:
        (n,) int64, -1 where there is none.
    """
    numbers = np.full(len(span), -1, dtype=np.int64)
    for number in sorted(span.windows, key=lambda n: (-windows[n].end, windows[n].start)):
        numbers[windows[number].start - span.start : windows[number].end - span.start] = number
    return numbers


def missing_frames(spans: list[Span], present: np.ndarray) -> list[int]:
    """Frames that episodes need and the source lacks, sorted.

    Args:
        spans: The episodes.
        present: (n,) sorted frame numbers of the source.
    """
    if not spans:
        return []
    wanted = np.zeros(max(span.end for span in spans) + 1, dtype=bool)
    for span in spans:
        wanted[span.start : span.end] = True
    wanted[present[present < len(wanted)]] = False
    return np.flatnonzero(wanted).tolist()


def as_ranges(frames: list[int]) -> str:
    """Frame numbers in a few words: `5, 8-11, 20`."""
    numbers = np.array(sorted(frames))
    parts = np.split(numbers, np.flatnonzero(np.diff(numbers) != 1) + 1) if frames else []
    words = [str(part[0]) if len(part) == 1 else f"{part[0]}-{part[-1]}" for part in parts]
    return ", ".join(words[:20]) + (f" and {len(words) - 20} more ranges" if len(words) > 20 else "")
