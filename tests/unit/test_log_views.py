"""What Foxglove and rerun see of a log: read by the plain mcap and protobuf readers, as they do it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from deploy.info import describe_log
from protocols.catalogue import CALIBRATION, CAMERA_INFO, OBSERVATION, RIG_INFO, TRACK
from protocols.geometry import so3
from protocols.geometry.pose import Pose
from protocols.log.reader import LogReader
from protocols.log.views import quaternion
from protocols.log.writer import LogWriter
from protocols.messages import syncline_pb2 as pb
from tests.samples import calibration, camera_info, observation, rig_info, track

mcap_protobuf = pytest.importorskip("mcap_protobuf.decoder")
TIME_NS = 1_700_000_000_250_000_000


def write(path: Path, *messages: tuple[Any, str, Any]) -> Path:
    with LogWriter(path, views=True) as log:
        for topic, agent, message in messages:
            log.write(topic, agent, "yard", message, TIME_NS)
    return path


def seen(path: Path) -> dict[str, tuple[str, Any]]:
    """(schema, message) by channel, without any code of ours."""
    found = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[mcap_protobuf.DecoderFactory()])
        for schema, channel, _, message in reader.iter_decoded_messages():
            found[channel.topic] = (schema.name, message)
    return found


def test_a_run_is_shown_without_any_code_of_ours(tmp_path: Path) -> None:
    path = write(
        tmp_path / "a.mcap",
        (CAMERA_INFO, "cam0", camera_info("cam0")),
        (OBSERVATION, "cam0", observation("cam0")),
        (CALIBRATION, "hub", calibration()),
        (TRACK, "hub", track()),
    )
    found = seen(path)
    assert {key: schema for key, (schema, _) in found.items() if key.startswith("foxglove/")} == {
        "foxglove/yard/cam0/calibration": "foxglove.CameraCalibration",
        "foxglove/yard/cam0/annotations": "foxglove.ImageAnnotations",
        "foxglove/yard/transforms": "foxglove.FrameTransforms",
        "foxglove/yard/scene": "foxglove.SceneUpdate",
    }
    lens = found["foxglove/yard/cam0/calibration"][1]
    assert (lens.frame_id, lens.width, lens.height, lens.distortion_model) == ("cam0", 640, 480, "plumb_bob")
    assert list(lens.K) == list(camera_info().matrix)
    assert list(lens.D) == list(camera_info().distortions)
    assert (len(lens.R), len(lens.P)) == (9, 12)
    circle = found["foxglove/yard/cam0/annotations"][1].circles[0]
    assert (circle.position.x, circle.position.y, circle.diameter) == (320.5, 240.25, 12.5)
    assert (circle.timestamp.seconds, circle.timestamp.nanos) == (1_700_000_000, 250_000_000)
    entity = found["foxglove/yard/scene"][1].entities[0]
    place = entity.spheres[0].pose.position
    assert (entity.frame_id, entity.id, place.x, place.y, place.z) == ("world", "marker", 1.0, 2.0, 3.0)


def test_a_transform_puts_a_camera_where_it_stands_and_turns_its_axis_into_the_world(tmp_path: Path) -> None:
    """A viewer computes p_world = rotation · p_camera + translation; z is the optical axis."""
    pose = Pose(so3.exp(np.array([0.4, -1.9, 0.7])), np.array([3.0, -2.0, 1.5]))
    message = calibration()
    message.cameras[0].rotation[:] = pose.rodrigues.tolist()
    message.cameras[0].translation[:] = pose.translation.tolist()
    transform = seen(write(tmp_path / "a.mcap", (CALIBRATION, "hub", message)))["foxglove/yard/transforms"][1]
    (found,) = transform.transforms
    assert (found.parent_frame_id, found.child_frame_id) == ("world", "cam0")
    q, t = found.rotation, found.translation
    ahead = np.array(
        [2 * (q.x * q.z + q.w * q.y), 2 * (q.y * q.z - q.w * q.x), 1 - 2 * (q.x**2 + q.y**2)]
    )  # the third column of the quaternion's matrix
    point = np.array([t.x, t.y, t.z]) + 2.5 * ahead
    np.testing.assert_allclose([t.x, t.y, t.z], [3.0, -2.0, 1.5], atol=1e-12)
    np.testing.assert_allclose(pose.world_from_camera(np.array([[0.0, 0.0, 2.5]]))[0], point, atol=1e-12)


def test_quaternions_of_all_kinds_of_turns() -> None:
    generator = np.random.default_rng(1)
    half_turns = [np.pi * np.eye(3)[axis] for axis in range(3)]
    for vector in [np.zeros(3), *half_turns, *generator.normal(0.0, 2.0, (50, 3))]:
        rotation = so3.exp(vector)
        q = quaternion(rotation)
        assert q.w >= 0.0
        w, v = q.w, np.array([q.x, q.y, q.z])
        again = (w**2 - v @ v) * np.eye(3) + 2 * np.outer(v, v) + 2 * w * so3.hat(v)
        np.testing.assert_allclose(again, rotation, atol=1e-9)


def test_lengths_are_metres_whatever_the_rig_uses(tmp_path: Path) -> None:
    rig = rig_info()
    rig.units = "cm"
    found = seen(write(tmp_path / "a.mcap", (RIG_INFO, "hub", rig), (TRACK, "hub", track())))
    place = found["foxglove/yard/scene"][1].entities[0].spheres[0].pose.position
    assert (place.x, place.y, place.z) == pytest.approx((0.01, 0.02, 0.03))
    arbitrary = calibration()
    arbitrary.units, arbitrary.scale = "cm", "arbitrary"
    found = seen(write(tmp_path / "b.mcap", (CALIBRATION, "hub", arbitrary), (TRACK, "hub", track())))
    assert found["foxglove/yard/scene"][1].entities[0].spheres[0].pose.position.x == 1.0


def test_a_lost_track_goes_out_of_the_picture(tmp_path: Path) -> None:
    lost = track()
    lost.state = "lost"
    scene = seen(write(tmp_path / "a.mcap", (TRACK, "hub", lost)))["foxglove/yard/scene"][1]
    assert not scene.entities
    assert scene.deletions[0].id == "marker"


def test_a_lens_that_the_hub_found_is_shown_where_the_camera_has_none(tmp_path: Path) -> None:
    bare = camera_info()
    del bare.matrix[:]
    path = write(tmp_path / "a.mcap", (CAMERA_INFO, "cam0", bare), (CALIBRATION, "hub", calibration()))
    lens = seen(path)["foxglove/yard/cam0/calibration"][1]
    assert (lens.width, lens.height, lens.distortion_model) == (640, 480, "kannala_brandt")
    empty = seen(write(tmp_path / "b.mcap", (CALIBRATION, "hub", pb.Calibration(schema_version=1, status="refused"))))
    assert list(empty) == ["syncline/yard/hub/hub/calibration"]


def test_our_own_readers_pass_over_what_is_for_viewers(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", (OBSERVATION, "cam0", observation("cam0")), (TRACK, "hub", track()))
    reader = LogReader(path)
    assert [item.topic for item in reader.messages()] == [OBSERVATION, TRACK]
    assert reader.counters == {}
    assert describe_log(path).messages == 2
    assert sum(1 for _ in reader.raw()) == 4
