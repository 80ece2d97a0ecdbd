"""Checkpoints come back as they were saved, or say what is wrong with them; damage never goes unnoticed."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from senior import checkpoint, replay
from senior.checkpoint import newest, restore, save
from senior.files import Damaged, pack, unpack, write_atomically
from senior.learner import Run
from senior.replay import Fact
from senior.rundir import saved_steps

CAPACITY = 6


def empty(capacity: int = CAPACITY) -> Run:
    """A state with arrays of several types in the place of networks."""
    return Run(
        seed=jnp.uint32(3),
        numbers={"rate": jnp.float32(0)},  # pyright: ignore[reportArgumentType]
        agent=(jnp.zeros((2, 3)), jnp.zeros((), jnp.int32)),  # pyright: ignore[reportArgumentType]
        model=None,
        replay=replay.init(capacity, 4, 2),
        entropy=None,
        deviation=None,
        bonus={"ready": jnp.bool_(False)},
        length_scale=jnp.float32(1),
        learned_return=jnp.float32(0),
    )


def advanced(run: Run, to: int) -> Run:
    """The state after ``to`` facts in all, every number of it a function of ``to``."""
    store = run.replay
    for row in range(int(store.count), to):
        rng = np.random.default_rng(row)
        fact = Fact(
            rng.normal(size=4).astype(np.float32),
            rng.uniform(-1, 1, 2).astype(np.float32),
            np.float32(rng.normal()),
            rng.normal(size=4).astype(np.float32),
            np.bool_(row % 5 == 4),
            np.bool_(row % 7 == 6),
            np.int32(row // 5),
        )  # pyright: ignore[reportArgumentType]
        store = replay.store(store, fact, jnp.float32(row / 3), jnp.float32(row / 7))
    rng = np.random.default_rng([1, to])
    return run._replace(
        numbers={"rate": jnp.float32(rng.normal())},
        agent=(jnp.array(rng.normal(size=(2, 3)), jnp.float32), jnp.int32(to)),
        replay=store,
        bonus={"ready": jnp.bool_(to % 2)},
        length_scale=jnp.float32(rng.normal()),
        learned_return=jnp.float32(rng.normal()),
    )


def progress(step: int) -> dict[str, Any]:
    return {"step": step, "return": 0.1 * step, "recent": [[step, 0, 5]], "success": None}


def saved(directory: Path, *at: int) -> Run:
    """Checkpoints after so many facts; the last state."""
    run, written = empty(), 0
    for step in at:
        run = advanced(run, step)
        written = save(directory, step, run, progress(step), written)
        assert written == step
    return run


def assert_equal(one: Run, other: Run) -> None:
    left, right = jax.tree_util.tree_leaves_with_path(one), jax.tree_util.tree_leaves(other)
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for (path, value), wanted in zip(left, right, strict=True):
        assert value.dtype == wanted.dtype
        np.testing.assert_array_equal(value, wanted, err_msg=jax.tree_util.keystr(path))


def name(step: int) -> str:
    return f"step-{step:010d}.npz"


@pytest.mark.parametrize("at", [(2,), (2, 5), (2, 6, 7), (3, 8, 13, 20), (4, 30)], ids=str)
def test_what_is_saved_comes_back_however_the_replay_wraps(at: tuple[int, ...], tmp_path: Path):
    last = saved(tmp_path, *at)
    told: list[str] = []
    found = newest(tmp_path, empty, told.append)
    assert found is not None
    step, run, about = found
    assert step == at[-1]
    assert about == progress(at[-1])
    assert_equal(run, last)
    assert not told


def test_there_is_none_at_first(tmp_path: Path):
    assert newest(tmp_path / "nothing", empty, pytest.fail) is None
    (tmp_path / "facts-0000000000-0000000002.npz").write_bytes(b"a chunk without a checkpoint")
    assert newest(tmp_path, empty, pytest.fail) is None


def test_the_two_newest_are_kept_and_facts_are_written_once(tmp_path: Path):
    saved(tmp_path, 1, 2, 3, 4)
    assert saved_steps(tmp_path) == [4, 3]
    chunks = [unpack(path) for path in sorted(tmp_path.glob("facts-*.npz"))]
    assert [len(chunk["reward"]) for chunk in chunks] == [1, 1, 1, 1]
    assert np.unique(np.concatenate([chunk["reward"] for chunk in chunks])).size == 4


def cut(data: bytes) -> bytes:
    return data[: len(data) // 2]


def flipped(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]


def noise(data: bytes) -> bytes:
    return np.random.default_rng(0).bytes(len(data))


def zeros(data: bytes) -> bytes:
    return bytes(len(data))


def empty_file(data: bytes) -> bytes:
    return b""


DAMAGE = (cut, flipped, noise, zeros, empty_file)


@pytest.mark.parametrize("which", ["checkpoint", "chunk"])
@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_checkpoint_is_named_and_the_one_before_serves(
    damage: Callable[[bytes], bytes], which: str, tmp_path: Path
):
    saved(tmp_path, 2, 5)
    path = tmp_path / (name(5) if which == "checkpoint" else "facts-0000000002-0000000005.npz")
    path.write_bytes(damage(path.read_bytes()))
    told: list[str] = []
    found = newest(tmp_path, empty, told.append)
    assert found is not None
    step, run, about = found
    assert (step, about) == (2, progress(2))
    assert_equal(run, advanced(empty(), 2))
    (sentence,) = told
    assert sentence.startswith(f"Checkpoint {path.name} is damaged (")
    assert sentence.endswith("; trying the one before.")

    # Going on from there, the damaged one takes nobody's place.
    run = advanced(run, 4)
    save(tmp_path, 4, run, progress(4), 2)
    assert saved_steps(tmp_path) == [4, 2]
    again = newest(tmp_path, empty, pytest.fail)
    assert again is not None
    assert_equal(again[1], run)


@pytest.mark.parametrize("which", ["checkpoint", "chunk"])
def test_what_the_system_does_not_give_is_not_taken_for_damaged(which: str, tmp_path: Path):
    """None is passed over for one before it, which would delete what is newer."""
    saved(tmp_path, 2, 5)
    path = tmp_path / (name(5) if which == "checkpoint" else "facts-0000000002-0000000005.npz")
    aside = path.rename(tmp_path / "aside")
    path.mkdir()  # whoever the user is, it cannot be read
    with pytest.raises(IsADirectoryError):
        newest(tmp_path, empty, pytest.fail)
    path.rmdir()
    aside.rename(path)
    found = newest(tmp_path, empty, pytest.fail)
    assert found is not None and found[0] == 5


def test_missing_facts_are_damage_too(tmp_path: Path):
    saved(tmp_path, 2, 5)
    (tmp_path / "facts-0000000002-0000000005.npz").unlink()
    with pytest.raises(Damaged, match=f"{name(5)} is damaged .facts from row 2 on are missing"):
        restore(tmp_path, 5, empty())


def test_if_all_are_damaged_each_is_named_and_none_is_used(tmp_path: Path):
    saved(tmp_path, 2, 5)
    for step in (2, 5):
        (tmp_path / name(step)).write_bytes(b"")
    told: list[str] = []
    assert newest(tmp_path, empty, told.append) is None
    assert [name(step) in sentence for step, sentence in zip((5, 2), told, strict=True)] == [True, True]
    assert saved_steps(tmp_path) == [5, 2]


def test_a_checkpoint_of_another_configuration_is_refused(tmp_path: Path):
    saved(tmp_path, 2)
    wider = empty()._replace(agent=(jnp.zeros((2, 4)), jnp.int32(0)))  # pyright: ignore[reportArgumentType]
    with pytest.raises(Damaged, match=r"agent\[0\] has another shape than the configuration says"):
        restore(tmp_path, 2, wider)


def test_a_checkpoint_of_another_format_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with monkeypatch.context() as then:
        then.setattr(checkpoint, "FORMAT", 99)
        saved(tmp_path, 2)
    with pytest.raises(Damaged, match=f"it has format 99, and this version reads format {checkpoint.FORMAT}"):
        restore(tmp_path, 2, empty())


@pytest.mark.parametrize("compress", [False, True])
def test_no_flipped_bit_goes_unnoticed(compress: bool, tmp_path: Path):
    rng = np.random.default_rng(0)
    arrays = {"some": np.repeat(rng.normal(size=12), 3).astype(np.float32), "other": rng.integers(9, size=5)}
    data, path = pack(arrays, compress), tmp_path / "file.npz"
    unharmed = damaged = 0
    for bit in range(0, 8 * len(data), 7):
        path.write_bytes(data[: bit // 8] + bytes([data[bit // 8] ^ 1 << bit % 8]) + data[bit // 8 + 1 :])
        try:
            found = unpack(path)
        except Damaged:
            damaged += 1
            continue
        unharmed += 1  # a bit that means nothing, a date for instance; a lost member is missed by who wants it
        for member, array in found.items():
            assert array.dtype == arrays[member].dtype
            np.testing.assert_array_equal(array, arrays[member])
    assert damaged > unharmed > 0


def test_a_half_written_file_is_no_checkpoint_and_is_cleared_away(tmp_path: Path):
    last = saved(tmp_path, 2, 5)
    half = tmp_path / (name(6) + ".tmp")
    half.write_bytes((tmp_path / name(5)).read_bytes()[:100])
    found = newest(tmp_path, empty, pytest.fail)
    assert found is not None
    assert found[0] == 5
    assert_equal(found[1], last)
    assert not half.exists()


def test_a_write_that_breaks_off_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "file"
    write_atomically(path, b"old")

    def broken(descriptor: int) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(os, "fsync", broken)
    with pytest.raises(OSError, match="no space left"):
        write_atomically(path, b"the new one")
    assert path.read_bytes() == b"old"


def test_the_bytes_are_on_the_disk_before_the_name_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    done: list[str] = []
    fsync, rename = os.fsync, os.replace

    def synced(descriptor: int) -> None:
        done.append("directory" if os.path.isdir(f"/proc/self/fd/{descriptor}") else "file")
        fsync(descriptor)

    def renamed(old: Path, new: Path) -> None:
        done.append("name")
        rename(old, new)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", renamed)
    write_atomically(tmp_path / "file", b"new")
    assert done == ["file", "name", "directory"]


class Mischief:
    """Makes a directory when it is unpickled."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.target),)


def test_nothing_is_ever_unpickled(tmp_path: Path):
    target = tmp_path / "made-by-pickle"
    saved(tmp_path, 2)
    path = tmp_path / name(2)
    content = unpack(path)
    content["about"] = np.array([Mischief(target)], dtype=object)
    np.savez(path, **content)  # pyright: ignore[reportArgumentType]
    with pytest.raises(Damaged, match="allow_pickle"):
        restore(tmp_path, 2, empty())
    assert not target.exists()
    np.load(path, allow_pickle=True)["about"]
    assert target.exists(), "this file would not have done any harm, so the test shows nothing"
    with pytest.raises(ValueError, match="allow_pickle"):
        pack({"about": np.array([Mischief(target)], dtype=object)})


def test_the_facts_after_the_checkpoint_that_serves_are_forgotten(tmp_path: Path):
    """A run that goes on from an older checkpoint may, with another teacher, live through other facts."""
    saved(tmp_path, 2, 5)
    (tmp_path / name(5)).write_bytes(b"")
    newest(tmp_path, empty, lambda _: None)
    assert [path.name for path in tmp_path.glob("facts-*.npz")] == ["facts-0000000000-0000000002.npz"]
