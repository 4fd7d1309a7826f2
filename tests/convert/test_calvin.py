"""Reading CALVIN's files: what is admitted, and how each defect is reported."""

import errno
import io
import os
import pickle
import struct
import tracemalloc
import zipfile

import numpy as np
import pytest
from fake_calvin import write_calvin
from numpy._core.multiarray import _reconstruct, scalar
from numpy._core.numeric import _frombuffer

from dataset_convert import blocks, checks
from dataset_convert.calvin import CalvinSplit
from dataset_convert.frames import VECTORS
from dataset_convert.safe_pickle import load_object_array
from lerobot_lansar.calvin import BLOCK_ORDER, relative_action

INDEX_FILES = ("scene_info.npy", "ep_start_end_ids.npy", "lang_annotations/auto_lang_ann.npy")


def read_all(calvin):
    split = CalvinSplit(calvin.root, "training")
    for window in split.windows:
        frames = range(window.start, window.end)
        checks.check_frames(split.read(frames, VECTORS), frames, split)


def test_a_valid_split_passes_every_check(calvin):
    read_all(calvin)


def test_the_end_of_a_window_is_exclusive(calvin):
    split = CalvinSplit(calvin.root, "training")
    assert [(w.start, w.end, len(w)) for w in split.windows] == [(s, e, 12) for s, e, *_ in calvin.windows]
    assert split.windows[0].end == split.windows[1].start


def test_an_index_file_that_names_code_is_refused_and_not_run(tmp_path):
    class Bomb:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "exploded"),)

    path = tmp_path / "bomb.npy"
    np.save(path, {"language": Bomb()}, allow_pickle=True)
    with pytest.raises(ValueError, match=r"bomb\.npy.*refused to load"):
        load_object_array(path)
    assert not (tmp_path / "exploded").exists()


def write_index(path, pickled):
    """An index file of a pickle made by hand."""
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": ()})
        file.write(pickled)
    return path


def as_by_numpy_1(pickled):
    """The same pickle with the names of numpy 1's modules, which are a letter shorter."""
    for name in (b"numpy._core.multiarray", b"numpy._core.numeric"):
        old = name.replace(b"_core", b"core")
        pickled = pickled.replace(bytes([len(name)]) + name, bytes([len(old)]) + old).replace(name, old)
    return pickled + bytes(8)  # a frame says how long the pickle was


ARRAYS = {
    **{name: np.arange(6).reshape(2, 3).astype(name) for name in ("b1", "i1", "i2", "i4", "i8", "u1", "u8")},
    **{name: np.linspace(-1, 1, 6).reshape(2, 3).astype(name) for name in ("f2", "f4", "f8", ">f8", ">i2")},
    "bytes": np.array([b"a", b"abc"]),
    "text": np.array(["açai", "", "𝄞"]),
    "big-endian text": np.array(["açai"]).astype(">U5"),
    "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    "every other": np.arange(12)[::2],
    "0-d": np.array(7.5),
    "empty": np.zeros((0, 3)),
    "embeddings": np.ones((4, 1, 384), np.float32),
}
SCALARS = [np.int64(-3), np.uint8(200), np.float32(0.1), np.bool_(True), np.str_("açai"), np.bytes_(b"abc")]
PLAIN = ["açai", b"\xff", b"", 2**70, -1, 0.5, None, True, (1, ("x", [2])), {}, {"a": {1: [3]}}]


@pytest.mark.parametrize("written", [as_by_numpy_1, bytes], ids=["numpy 1", "numpy 2"])
@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_index_files_of_all_numpy_and_pickle_versions_load(tmp_path, protocol, written):
    objects = np.empty((2, 3), dtype=object, order="F")
    for place, item in enumerate([1, "x", np.arange(3), [np.arange(2)], np.array(None), (np.float64(2),)]):
        objects[divmod(place, 3)] = item
    twice = np.arange(5)
    stored = {
        "arrays": ARRAYS,
        "scalars": SCALARS,
        "plain": PLAIN,
        "objects": objects,
        "twice": [twice, (twice,)],
    }
    pickled = pickle.dumps(np.array(stored, dtype=object), protocol=protocol)
    loaded = load_object_array(write_index(tmp_path / "index.npy", written(pickled)))
    assert list(loaded) == list(stored)
    assert list(loaded["arrays"]) == list(ARRAYS)
    for name, array in ARRAYS.items():
        read = loaded["arrays"][name]
        assert type(read) is np.ndarray
        assert read.dtype == array.dtype
        assert read.flags.writeable
        np.testing.assert_array_equal(read, array, strict=True, err_msg=name)
    assert loaded["arrays"]["fortran"].flags.f_contiguous
    assert loaded["scalars"] == [number.item() for number in SCALARS]
    assert loaded["plain"] == PLAIN
    read = loaded["objects"]
    assert read.shape == (2, 3)
    assert list(read[0, :2]) == [1, "x"]
    assert read[0, 2].tolist() == [0, 1, 2]
    assert read[1, 0][0].tolist() == [0, 1]
    assert read[1, 1:].tolist() == [None, (2.0,)]
    assert loaded["twice"][0] is loaded["twice"][1][0]


class Call:
    """Pickles as a call, whose result may be given a state."""

    def __init__(self, *call):
        self.call = call

    def __reduce__(self):
        return self.call


def array_of(shape, dtype, content):
    return Call(_reconstruct, (np.ndarray, (0,), b"b"), (1, shape, dtype, False, content))


OBJECTS_WITHOUT_FLAGS = Call(np.dtype, ("O8", False, True), (3, "|", None, None, None, -1, -1, 0))
CRAFTED = {
    "addresses in an array's bytes": array_of((1,), OBJECTS_WITHOUT_FLAGS, b"A" * 8),
    "addresses in a buffer": Call(_frombuffer, (b"A" * 8, OBJECTS_WITHOUT_FLAGS, (1,), "C")),
    "an address in a scalar": Call(scalar, (OBJECTS_WITHOUT_FLAGS, b"A" * 8)),
    "memory that nobody filled": Call(np.ndarray, ((64,), "u1")),
    "more memory than there is": Call(np.ndarray, ((1 << 46,), "u1")),
    "a shape larger than the content": array_of((1 << 46,), np.dtype("u1"), b"A" * 8),
    "a shape smaller than the content": array_of((1,), np.dtype("u1"), b"A" * 8),
    "a shape to be guessed": array_of((-1,), np.dtype("u1"), b"A" * 8),
    "fewer objects than there should be": array_of((3,), np.dtype("O"), [1, 2]),
    "a dtype with fields": array_of((1,), np.dtype([("a", "O")]), b"A" * 8),
    "characters that do not exist": array_of((1,), np.dtype("U1"), b"\xff\xff\xff\x7f"),
    "a string longer than its content": Call(scalar, (np.dtype("S8"), b"A")),
    "a dtype and no array": np.dtype("f8"),
}


@pytest.mark.parametrize("crafted", CRAFTED.values(), ids=CRAFTED)
def test_an_array_that_is_not_what_it_says_neither_crashes_nor_takes_memory(tmp_path, crafted):
    path = write_index(tmp_path / "crafted.npy", pickle.dumps({"language": crafted}, protocol=4))
    with pytest.raises(ValueError, match=r"crafted\.npy: not an index file"):
        load_object_array(path)


def test_memory_beyond_an_array_cannot_be_read_through_a_dtype_that_grows_afterwards(tmp_path):
    dtype = b"cnumpy\ndtype\n(VS8\nI00\nI01\ntRp1\n0"
    array = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\ntVb\ntR(I1\n(I1\ntg1\nI00\nC\x08ABCDEFGHtb"
    growth = b"g1\n(I3\nV|\nNNNI4096\nI1\nI0\ntb0"
    path = write_index(tmp_path / "leak.npy", dtype + array + growth + b".")
    assert load_object_array(path).tolist() == [b"ABCDEFGH"]


@pytest.mark.parametrize(
    "pickled",
    [
        b"\x80\x02]r\xff\xff\xff\x7f.",  # place 2**31 in the unpickler's list of objects
        b"\x80\x05\x96" + struct.pack("<Q", 1 << 36) + b".",  # bytes
        b"\x80\x04\x95" + struct.pack("<Q", 1 << 62) + b"N.",  # a frame
        b"\x80\x02" + b"(" * 10_000 + b"l" * 10_000 + b".",  # lists in lists
        b"\x80\x02]q\x01h\x01a.",  # a list in itself
    ],
    ids=["place", "bytes", "frame", "depth", "circle"],
)
def test_a_pickle_that_asks_for_more_than_it_is_does_not_get_it(tmp_path, pickled):
    path = write_index(tmp_path / "greedy.npy", pickled)
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=r"greedy\.npy: not an index file"):
            load_object_array(path)
        assert tracemalloc.get_traced_memory()[1] < 16 << 20
    finally:
        tracemalloc.stop()


def test_a_command_that_is_not_text_is_refused(calvin):
    path = calvin.root / "training" / INDEX_FILES[2]
    listed = load_object_array(path)
    listed["language"]["ann"][1] = ["open", "it"]
    np.save(path, listed, allow_pickle=True)
    with pytest.raises(ValueError, match=r"auto_lang_ann\.npy.*not a string"):
        CalvinSplit(calvin.root, "training")


def test_a_missing_frame_is_named(calvin):
    calvin.file(105).unlink()
    with pytest.raises(FileNotFoundError, match=r"episode_0000105\.npz is missing"):
        read_all(calvin)


@pytest.mark.parametrize("keep", [0, 100, -30])
def test_a_truncated_frame_is_named(calvin, keep):
    content = calvin.file(105).read_bytes()
    calvin.file(105).write_bytes(content[:keep])
    with pytest.raises(ValueError, match=r"episode_0000105\.npz: truncated"):
        read_all(calvin)


def test_a_damaged_offset_inside_a_frame_is_noticed(calvin):
    content = bytearray(calvin.file(105).read_bytes())
    content[-6:-2] = struct.pack("<I", 1 << 20)  # the directory's: arrays then start before the file does
    calvin.file(105).write_bytes(content)
    with pytest.raises(ValueError, match=r"episode_0000105\.npz: truncated"):
        read_all(calvin)


def test_a_flipped_byte_inside_a_frame_is_noticed(calvin):
    content = bytearray(calvin.file(105).read_bytes())
    content[200] ^= 1
    calvin.file(105).write_bytes(bytes(content))
    with pytest.raises(ValueError, match=r"episode_0000105\.npz"):
        read_all(calvin)


def outcomes_of_flips(path, attempt, named, count):
    """How often `attempt` succeeds after one bit of the file was flipped; where it fails, the error names a file."""
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    successes = 0
    for place, bit in zip(rng.integers(len(content), size=count), rng.integers(8, size=count), strict=True):
        damaged = bytearray(content)
        damaged[place] ^= 1 << bit
        path.write_bytes(damaged)
        try:
            attempt()
            successes += 1
        except (FileNotFoundError, ValueError) as error:
            assert any(name in str(error) for name in named), f"byte {place}, bit {bit}: {error!r}"  # noqa: PT017
    path.write_bytes(content)
    return successes


@pytest.mark.parametrize("packed", [False, True])
def test_no_flipped_bit_of_a_frame_gives_anything_but_an_error_that_names_it(calvin, packed):
    path = calvin.file(105)
    if packed:
        np.savez_compressed(path, **calvin.frames[105])
    split = CalvinSplit(calvin.root, "training")
    successes = outcomes_of_flips(path, lambda: split.read([105], VECTORS), [path.name], 600)
    assert 0 < successes < 300  # some bits mean nothing, such as dates


@pytest.mark.parametrize("name", INDEX_FILES)
def test_no_flipped_bit_of_an_index_file_gives_anything_but_an_error_that_names_it(calvin, name):
    path = calvin.root / "training" / name
    named = [os.path.basename(file) for file in INDEX_FILES]
    assert outcomes_of_flips(path, lambda: CalvinSplit(calvin.root, "training"), named, 300) < 300


@pytest.mark.parametrize(
    "header", ["-" * 9000 + "1", "(" * 9000, "{'descr': 'f8,(', 'fortran_order': False, 'shape': (7,), }"]
)
@pytest.mark.parametrize("name", ["episode_0000105.npz", *INDEX_FILES])
def test_a_header_that_python_cannot_parse_is_an_error_that_names_the_file(calvin, name, header):
    content = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode()
    path = calvin.root / "training" / name
    if path.suffix == ".npz":
        with zipfile.ZipFile(path, "w") as file:
            for key in VECTORS:
                file.writestr(f"{key}.npy", content)
    else:
        path.write_bytes(content)
    with pytest.raises(ValueError, match=path.name):
        read_all(calvin)


def test_a_fault_of_the_machine_is_not_called_a_defect_of_the_file(calvin, monkeypatch):
    split = CalvinSplit(calvin.root, "training")
    reads, lifetime = 0, 1000

    class Disk(io.FileIO):
        def read(self, size=-1):
            nonlocal reads
            reads += 1
            if reads > lifetime:
                raise OSError(errno.EIO, os.strerror(errno.EIO))
            return super().read(size)

    monkeypatch.setattr("io.open", lambda path, mode: Disk(path))
    split.read([105], VECTORS)
    needed, faults = reads, []
    for place in range(needed):
        reads, lifetime = 0, place
        with pytest.raises(OSError, match=r"Input/output error.*episode_0000105\.npz") as caught:
            split.read([105], VECTORS)
        faults.append(caught.value.errno)
    assert needed > 5
    assert set(faults) == {errno.EIO}


@pytest.mark.parametrize("code", [errno.EMFILE, errno.EACCES])
@pytest.mark.parametrize("name", ["episode_0000105.npz", *INDEX_FILES])
def test_a_file_that_cannot_be_opened_is_not_called_defective(calvin, monkeypatch, name, code):
    opened = io.open

    def refuse(path, *arguments, **options):
        if str(path).endswith(name):
            raise OSError(code, os.strerror(code), str(path))
        return opened(path, *arguments, **options)

    monkeypatch.setattr("io.open", refuse)
    with pytest.raises(OSError, match=os.path.basename(name)) as caught:
        read_all(calvin)
    assert caught.value.errno == code


@pytest.mark.parametrize("claims", ["its true size", "a small size"])
def test_an_array_that_unpacks_to_a_huge_one_is_refused_before_it_does(calvin, claims):
    size = 64 << 20
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
        for key in VECTORS:
            file.writestr(f"{key}.npy", bytes(size))
    packed = content.getvalue()
    if claims == "a small size":
        packed = packed.replace(struct.pack("<I", size), struct.pack("<I", 248))
    calvin.file(105).write_bytes(packed)
    split = CalvinSplit(calvin.root, "training")
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=r"episode_0000105\.npz"):
            split.read([105], VECTORS)
        assert tracemalloc.get_traced_memory()[1] < 4 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_an_array_packed_in_a_way_that_cannot_be_unpacked_in_steps_is_refused(calvin, method):
    with zipfile.ZipFile(calvin.file(105), "w", method) as file:
        for key in VECTORS:
            file.writestr(f"{key}.npy", bytes(200))
    with pytest.raises(ValueError, match=r"episode_0000105\.npz.*compressed by method"):
        read_all(calvin)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("scene_obs", None, "array 'scene_obs' is missing"),
        ("robot_obs", np.zeros(14), r"'robot_obs' is float64 \(14,\), expected float \(15,\)"),
        ("actions", np.zeros(7, dtype=np.int64), r"'actions' is int64 \(7,\), expected float"),
        ("scene_obs", np.full(24, np.nan), "'scene_obs' holds a number that is not finite"),
        ("actions", np.full(7, 0.5), "gripper command 0.5"),
        ("rel_actions", np.full(7, 0.123), r"rel_actions\[0\] is 0.123000, but"),
    ],
)
def test_a_wrong_array_is_reported_with_its_file(calvin, key, value, message):
    calvin.rewrite(107, **{key: value})
    with pytest.raises(ValueError, match=rf"episode_0000107\.npz.*{message}"):
        read_all(calvin)


def test_object_arrays_in_a_frame_are_refused(calvin):
    calvin.rewrite(107, actions=np.array([{}] * 7, dtype=object))
    with pytest.raises(ValueError, match=r"episode_0000107\.npz"):
        read_all(calvin)


def test_a_window_across_two_recordings_is_refused(calvin):
    np.save(calvin.root / "training" / "ep_start_end_ids.npy", np.array([[100, 105], [106, 147]]))
    with pytest.raises(ValueError, match=r"auto_lang_ann.npy: window \[100, 112\) of .* is not inside one recording"):
        CalvinSplit(calvin.root, "training")


def test_a_window_outside_every_scene_is_refused(calvin):
    np.save(calvin.root / "training" / "scene_info.npy", {"calvin_scene_D": [100, 120]}, allow_pickle=True)
    with pytest.raises(ValueError, match="lies in no scene"):
        CalvinSplit(calvin.root, "training")


@pytest.mark.parametrize("name", INDEX_FILES)
def test_a_missing_or_damaged_index_file_is_named(calvin, name):
    path = calvin.root / "training" / name
    path.write_bytes(path.read_bytes()[:90])
    with pytest.raises(ValueError, match=path.name):
        CalvinSplit(calvin.root, "training")
    path.unlink()
    with pytest.raises(FileNotFoundError, match=path.name):
        CalvinSplit(calvin.root, "training")


def test_a_missing_split_is_reported_with_those_found(calvin):
    with pytest.raises(FileNotFoundError, match=r"--split=validation.*splits found: training"):
        CalvinSplit(calvin.root, "validation")


def test_relative_actions_wrap_angles_and_clip():
    robot_obs = np.zeros((1, 15))
    robot_obs[0, 3:6] = 3.13, -3.13, 0.0
    actions = np.array([[0.01, -1.0, 0.0, -3.13, 3.13, 0.025, -1.0]])
    turn = 2 * np.pi - 6.26
    expected = [[0.5, -1, 0, turn / 0.05, -turn / 0.05, 0.5, -1]]
    np.testing.assert_allclose(relative_action(actions, robot_obs), expected, atol=1e-12)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_half_a_turn_may_be_stored_with_either_sign(calvin, sign):
    robot_obs, actions = calvin.frames[103]["robot_obs"].copy(), calvin.frames[103]["actions"].copy()
    actions[4] = robot_obs[4] + np.pi
    rel = relative_action(actions[None], robot_obs[None])[0]
    rel[4] = sign
    calvin.rewrite(103, actions=actions, rel_actions=rel)
    read_all(calvin)
    rel[4] = 0.9
    calvin.rewrite(103, actions=actions, rel_actions=rel)
    with pytest.raises(ValueError, match=r"rel_actions\[4\]"):
        read_all(calvin)


def order_of(calvin, scene):
    return blocks.block_order(scene, blocks.gather_evidence(CalvinSplit(calvin.root, "training"), scene))


@pytest.mark.parametrize("scene", "ABCD")
def test_lifts_confirm_the_block_order_of_each_scene(tmp_path, scene):
    assert order_of(write_calvin(tmp_path, scene=scene), scene) == BLOCK_ORDER[scene]


def test_lifts_overrule_a_known_block_order_only_on_request(tmp_path):
    reordered = write_calvin(tmp_path, scene="A", block_order=("red", "blue", "pink"))
    evidence = blocks.gather_evidence(CalvinSplit(reordered.root, "training"), "A")
    with pytest.raises(ValueError, match="scene A: its lifts show the order red, blue, pink"):
        blocks.block_order("A", evidence)
    assert blocks.block_order("A", evidence, "known") == ("pink", "blue", "red")
    assert blocks.block_order("A", evidence, "lifts") == ("red", "blue", "pink")


def test_an_unknown_scene_needs_lifts_to_tell_its_blocks_apart(tmp_path):
    lifted = write_calvin(tmp_path / "lifts", scene="X", block_order=("blue", "pink", "red"))
    assert order_of(lifted, "X") == ("blue", "pink", "red")
    silent = write_calvin(tmp_path / "silent", scene="X", block_order=("blue", "pink", "red"), tasks=("open_drawer",))
    with pytest.raises(ValueError, match=r"scene X: cannot tell.*known order: none"):
        order_of(silent, "X")


def test_a_known_scene_without_lifts_keeps_its_order(tmp_path):
    assert order_of(write_calvin(tmp_path, scene="C", tasks=("open_drawer",)), "C") == ("blue", "red", "pink")


def test_one_wrongly_named_lift_does_not_change_the_order():
    evidence = blocks.Evidence(np.array([[9, 0, 1], [0, 8, 0], [0, 0, 9]]), [])
    assert blocks.block_order("D", evidence) == ("red", "blue", "pink")
    assert blocks.block_order("X", evidence) == ("red", "blue", "pink")


def test_reordering_moves_whole_blocks():
    scene_obs = np.arange(24.0)[None]
    reordered = blocks.reorder_blocks(scene_obs, ("pink", "blue", "red"))[0]
    assert reordered.tolist() == [*range(6), *range(18, 24), *range(12, 18), *range(6, 12)]
