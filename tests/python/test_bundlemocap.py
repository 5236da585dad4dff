"""The module of the wheel: `pip install '.[bus]' pytest`, then `pytest tests/python`."""

import os
import signal
import subprocess
import threading
import time
from pathlib import Path

import bundlemocap as bm
import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
WALK = ROOT / "recordings/walk.mcap"


@pytest.fixture(scope="module")
def recording() -> bm.Recording:
    return bm.Recording.read(WALK)


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory) -> tuple[bm.Solved, Path]:
    out = tmp_path_factory.mktemp("solved") / "out"
    return bm.solve(WALK, out=out), out


def chain(motion: bm.Motion) -> np.ndarray:
    """The joint centres from the rotations: forward kinematics with the rest pose."""
    x, y, z, w = np.moveaxis(motion.rotations, 2, 0)
    turns = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]).transpose(2, 3, 0, 1)
    world, places = [turns[:, 0]], [motion.positions[:, 0]]
    for joint, parent in list(enumerate(bm.PARENTS))[1:]:
        bone = motion.rest_positions[joint] - motion.rest_positions[parent]
        places.append(places[parent] + world[parent] @ bone)
        world.append(world[parent] @ turns[:, joint])
    return np.stack(places, 1)


def test_a_recording_is_read_and_written(recording: bm.Recording, tmp_path: Path) -> None:
    path = tmp_path / "again.mcap"
    recording.write(path)
    again = bm.Recording.read(path)
    assert list(again.keypoints) == ["cam01", "cam02", "cam03", "cam04"]
    for name, keypoints in recording.keypoints.items():
        assert keypoints.points.shape[0] == 240 and keypoints.points.shape[2:] == (25, 3)
        assert len(bm.FORMATS[keypoints.format]) == 25
        np.testing.assert_array_equal(again.keypoints[name].points, keypoints.points)
        np.testing.assert_array_equal(again.keypoints[name].times_ns, keypoints.times_ns)
        assert again.keypoints[name].frames.tolist() == list(range(240))
        assert again.keypoints[name].size == recording.rig.cameras[0].size


def test_numbers_and_sizes_of_images_are_kept(recording: bm.Recording, tmp_path: Path) -> None:
    path = tmp_path / "lost.mcap"
    kept = np.flatnonzero(np.random.default_rng(1).random(240) > 0.3)

    def of(one: bm.Keypoints, frames: np.ndarray | None, size: tuple[int, int]) -> bm.Keypoints:
        return bm.Keypoints(one.times_ns[kept], one.points[kept], one.format, frames=frames, size=size)

    def take(frames: np.ndarray | None, size: tuple[int, int] = (1280, 1024)) -> bm.Recording:
        return bm.Recording(
            recording.rig, {name: of(one, frames, size) for name, one in recording.keypoints.items()}
        )

    take(kept).write(path)
    again = bm.Recording.read(path)
    assert again.keypoints["cam02"].frames.tolist() == kept.tolist()
    assert again.keypoints["cam02"].size == (1280, 1024)
    # A counter that does not show the losses is noticed too.
    for lost in [again, take(None)]:
        motion = bm.solve(lost).motions["actor"]
        assert motion.fps == pytest.approx(60, rel=1e-3) and abs(len(motion) - 240) < 10
    with pytest.raises(bm.Error, match="the recording: camera cam01 was calibrated with images of 1280 x 1024"):
        bm.solve(take(kept, (640, 512)))


def test_arrays_cannot_be_changed(recording: bm.Recording) -> None:
    keypoints = recording.keypoints["cam01"]
    with pytest.raises(ValueError, match="read-only"):
        keypoints.points[0] = np.nan
    with pytest.raises(TypeError, match="item deletion"):
        del recording.keypoints["cam03"]  # type: ignore[attr-defined]
    assert keypoints.points is keypoints.points
    masked = np.ma.masked_array(np.full((1, 17, 3), 0.5), mask=np.arange(51).reshape(1, 17, 3) < 3)
    points = bm.Keypoints([0], masked, "coco_17").points  # type: ignore[arg-type]
    assert np.isnan(points[0, 0, 0, 0]) and (points[0, 0, 1:] == 0.5).all()


def test_the_messages_of_a_recording_are_read(tmp_path: Path) -> None:
    found = [(topic, kind) for topic, _, kind, _ in bm.read_messages(WALK)]
    assert ("mocap/stage/camera/cam02/keypoints", "bundlemocap.v1.KeypointFrame") in found
    times = [time for topic, time, _, _ in bm.read_messages(WALK) if topic.endswith("cam02/keypoints")]
    assert len(times) == 240 and times == sorted(times)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(WALK.read_bytes()[: WALK.stat().st_size * 2 // 3])
    with pytest.warns(UserWarning, match="cut.mcap"):
        assert 0 < len(list(bm.read_messages(cut))) < len(found)
    with pytest.raises(bm.Error, match="not there"):
        bm.read_messages(tmp_path / "not there")


def test_an_interrupt_ends_a_solve(recording: bm.Recording, tmp_path: Path) -> None:
    def longer(one: bm.Keypoints) -> bm.Keypoints:
        turns = np.arange(20) * 4_000_000_000
        times = (one.times_ns[None] + turns[:, None]).reshape(-1)
        return bm.Keypoints(times, np.tile(one.points, (len(turns), 1, 1, 1)), one.format)

    long = bm.Recording(recording.rig, {name: longer(one) for name, one in recording.keypoints.items()})
    # It is ignored in a process that runs in the background.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT)).start()
        with pytest.raises(KeyboardInterrupt):
            bm.solve(long, out=tmp_path / "out")
            time.sleep(10)
    finally:
        signal.signal(signal.SIGINT, before)
    assert not (tmp_path / "out").exists()


def test_solve_gives_the_poses_of_its_files(solved: tuple[bm.Solved, Path]) -> None:
    found, out = solved
    motion = found.motions["actor"]
    assert (len(motion), motion.positions.shape) == (240, (240, 22, 3))
    assert motion.fps == pytest.approx(60, rel=1e-4)
    assert set(motion.states) == {"tracking"} and len(bm.JOINTS) == 22
    assert found.summary["performers"][0]["frames"] == 240
    again = bm.read_motions(out / "poses.mcap")["actor"]
    np.testing.assert_array_equal(again.rotations, motion.rotations)
    assert np.abs(chain(motion) - motion.positions).max() < 1e-5
    known = motion.deviations[np.isfinite(motion.deviations).all(1)]
    assert len(known) > 230 and 1e-3 < known.min() < known.max() < 0.1


def test_arrays_are_solved_like_their_recording(
    recording: bm.Recording, solved: tuple[bm.Solved, Path]
) -> None:
    keypoints = {
        name: bm.Keypoints(one.times_ns, one.points, one.format)
        for name, one in recording.keypoints.items()
    }
    cameras = [
        bm.Camera(one.name, one.size, one.matrix, one.rotation, one.translation, list(one.distortion))
        for one in recording.rig.cameras
    ]
    found = bm.solve(bm.Recording(bm.Rig(cameras), keypoints), performers=1)
    wanted = solved[0].motions["actor"].positions
    assert np.abs(found.motions["actor"].positions - wanted).max() < 1e-4


def test_the_tracker_solves_frame_by_frame(
    recording: bm.Recording, solved: tuple[bm.Solved, Path]
) -> None:
    points = {name: one.points for name, one in recording.keypoints.items()}
    frames = sorted(
        (int(time), name, frame)
        for name, one in recording.keypoints.items()
        for frame, time in enumerate(one.times_ns)
    )
    tracker, other = [bm.Tracker(recording.rig, "body_25") for _ in range(2)]
    poses = [pose for time, name, frame in frames for pose in tracker.add(name, time, points[name][frame])]
    assert len(poses) > 200, "poses come while frames are added"
    poses += tracker.end()
    motion = solved[0].motions["actor"]
    assert [pose.time_ns for pose in poses] == motion.times_ns.tolist()
    assert {pose.performer for pose in poses} == {"actor"}
    assert any("acquired" in event for event in tracker.take_events()) and not tracker.take_events()
    for time, name, frame in frames[:480]:
        if name == "cam03" and frame > 30:
            continue
        other.add(name, time, points[name][frame], frame)
    assert any(": cam03: " in event for event in other.take_events())
    assert not tracker.end()
    with pytest.raises(bm.Error, match="has ended"):
        tracker.add("cam01", frames[-1][0] + 20_000_000, points["cam01"][0])
    positions = np.array([pose.positions for pose in poses])
    far = np.linalg.norm(positions - motion.positions, axis=2)
    assert np.median(far) < 0.01 and far[20:].max() < 0.1


def test_a_camera_projects_as_the_pinhole_says(recording: bm.Recording, tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    recording.rig.write(path)
    for camera, again in zip(recording.rig.cameras, bm.Rig.read(path).cameras, strict=True):
        places = np.array([[0.0, 1.0, 0.0], [0.3, 1.5, -0.2]])
        wide = bm.Camera("c", camera.size, camera.matrix, camera.rotation, camera.translation, fisheye=True)
        assert wide.is_fisheye
        ideal = bm.Camera("c", camera.size, camera.matrix, camera.rotation, camera.translation)
        seen = camera.matrix @ (camera.rotation @ places.T + camera.translation[:, None])
        assert np.abs(ideal.project(places) - (seen[:2] / seen[2]).T).max() < 1e-6
        assert np.abs(again.project(places) - camera.project(places)).max() < 1e-6
        behind = -camera.rotation.T @ camera.translation - 5 * camera.rotation[2]
        assert np.isnan(ideal.project(behind[None])).all()


def test_other_numbers_are_taken() -> None:
    points = np.full((2, 17, 3), 0.5, np.float32)
    keypoints = bm.Keypoints([0, 1], points[:, ::-1], "coco_17")  # type: ignore[arg-type]
    assert (keypoints.points == 0.5).all() and keypoints.points.shape == (2, 1, 17, 3)
    assert (keypoints.points == 0.5).all() and keypoints.times_ns.tolist() == [0, 1]


def test_errors_say_what_is_wrong(recording: bm.Recording, tmp_path: Path) -> None:
    rig, format = recording.rig, "body_25"
    with pytest.raises(bm.Error, match="nowhere.mcap"):
        bm.solve(tmp_path / "nowhere.mcap")
    with pytest.raises(bm.Error, match="no camera \"cam9\"; it has cam01"):
        bm.Recording(rig, {"cam9": recording.keypoints["cam01"]})
    with pytest.raises(bm.Error, match="25 x 3"):
        bm.Keypoints(np.arange(3), np.zeros((3, 24, 3)), format)
    with pytest.raises(bm.Error, match=r"as many frames as times_ns \(4\)"):
        bm.Keypoints(np.arange(4), np.zeros((3, 25, 3)), format)
    with pytest.raises(bm.Error, match="halpe_26"):
        bm.Tracker(rig, "halpe_27")  # type: ignore[arg-type]
    for count in [0, -1]:
        with pytest.raises(bm.Error, match="performers"):
            bm.solve(WALK, performers=count)
    with pytest.raises(TypeError, match=r"whole numbers[\s\S]*times_ns"):
        bm.Keypoints(np.array([0.5]), np.zeros((1, 25, 3)), format)
    with pytest.raises(TypeError, match=r"numbers[\s\S]*points"):
        bm.Keypoints(np.arange(2), [[1.0], [1.0, 2.0]], format)  # type: ignore[arg-type]
    with pytest.raises(bm.Error, match="performers"):
        bm.Tracker(rig, format, performers=2.5)  # type: ignore[arg-type]
    with pytest.raises(bm.Error, match="size"):
        bm.Camera("c", (-1, 480), np.eye(3), np.eye(3), np.zeros(3))
    with pytest.raises(bm.Error, match="years 1684 to 2255"):
        bm.Keypoints([2**63 - 1], np.zeros((1, 25, 3)), format)  # type: ignore[arg-type]
    tracker = bm.Tracker(rig, format)
    nobody = np.zeros((25, 3))
    tracker.add("cam01", 0, nobody)
    for camera, time in [("cam01", 1), ("cam01", -20_000_000), ("cam02", 8 * 10**18)]:
        with pytest.raises(bm.Error, match="give nanoseconds"):
            tracker.add(camera, time, nobody)
    tracker.add("cam01", 20_000_000, nobody)
    with pytest.raises(bm.Error, match="one image"):
        tracker.add("cam01", 40_000_000, np.zeros((2, 3, 25, 3)))
    with pytest.raises(bm.Error, match="not negative"):
        tracker.add("cam01", 40_000_000, nobody, -1)
    with pytest.raises(bm.Error, match="frames: .*not negative"):
        bm.Keypoints(np.arange(1), np.zeros((1, 25, 3)), format, frames=np.array([-1]))
    with pytest.raises(bm.Error, match="holds no poses"):
        bm.read_motions(WALK)
    with pytest.raises(bm.Error, match="c/d"):
        bm.Camera("c/d", (640, 480), np.eye(3), np.eye(3), np.zeros(3))
    with pytest.raises(bm.Error, match="matrix: give an array of 3 x 3"):
        bm.Camera("c", (640, 480), np.eye(4), np.eye(3), np.zeros(3))
    out = tmp_path / "out"
    bm.solve(WALK, out=out)
    with pytest.raises(bm.Error, match="replace it with overwrite$"):
        bm.solve(WALK, out=out)
    bm.solve(WALK, out=out, overwrite=True)


def test_what_a_damaged_file_lost_is_said(
    solved: tuple[bm.Solved, Path], tmp_path: Path
) -> None:
    for source, read in [(WALK, bm.Recording.read), (solved[1] / "poses.mcap", bm.read_motions)]:
        cut = tmp_path / "cut.mcap"
        whole = source.read_bytes()
        cut.write_bytes(whole[: len(whole) // 2])
        with pytest.warns(UserWarning, match="cut.mcap"):
            read(cut)


def test_the_program_is_there(tmp_path: Path) -> None:
    def run(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(["bundlemocap", *words], capture_output=True, text=True, cwd=tmp_path)

    assert run("--version").stdout == f"bundlemocap {bm.__version__}\n"
    missing = run("info", "nowhere.mcap")
    assert missing.returncode == 3 and "nowhere.mcap" in missing.stderr


def test_messages_of_the_bus() -> None:
    bus = pytest.importorskip("bundlemocap.bus")
    for kind in bm.schemas():
        message = getattr(bus, kind.rpartition(".")[2])
        assert bus.decoded(kind, b"") == message() and isinstance(bus.decoded(kind, b""), message)
    assert bus.decoded("bundlemocap.v1.Future", b"") is None and bus.decoded("foxglove.Log", b"") is None
    states = [bus.state_of(bus.Pose(state=number)) for number in range(5)]
    assert states == ["unknown", "tracking", "coasting", "lost", "unknown"]
    assert bus.triples([1, 2, 0.5, 3, 4, 1]) == [(1, 2, 0.5), (3, 4, 1)]
    with pytest.raises(AttributeError, match="no message Future"):
        bus.Future
    with pytest.raises(bm.Error, match="is no address"):
        bus.open_session("nowhere")


def test_the_type_hints_are_those_of_the_module() -> None:
    checked = subprocess.run(
        ["python", "-m", "mypy.stubtest", "bundlemocap"], capture_output=True, text=True
    )
    assert checked.returncode == 0, checked.stdout


def test_the_notebook_runs(tmp_path: Path) -> None:
    nbformat, client = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    notebook = nbformat.read(ROOT / "docs/python.ipynb", 4)
    client.NotebookClient(notebook, resources={"metadata": {"path": ROOT / "docs"}}).execute()
    plots = [
        output
        for cell in notebook.cells
        for output in cell.get("outputs", [])
        if "image/png" in output.get("data", {})
    ]
    assert len(plots) == 3
