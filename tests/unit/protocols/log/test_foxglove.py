"""What Foxglove and rerun see of a log: read by the plain mcap and protobuf readers, as they do it."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.reader import make_reader

from deploy.logs.info import describe_log
from protocols.core.jpeg import jpeg_size
from protocols.geometry import so3
from protocols.geometry.pose import Pose
from protocols.log.layout import FOXGLOVE_SCHEMAS, schema_of
from protocols.log.read.reader import LogReader
from protocols.log.write.foxglove import quaternion
from protocols.log.write.writer import LogWriter
from protocols.messages import syncline_pb2 as pb
from protocols.topics import (
    CALIBRATION,
    CAMERA_INFO,
    FLIGHT_IMAGE,
    OBSERVATION,
    PICTURE,
    RIG_INFO,
    TARGET,
    TRACK,
    UAV_INFO,
)
from tests.support.samples import SAMPLES, calibration, camera_info, observation, picture, rig_info, track

mcap_protobuf = pytest.importorskip("mcap_protobuf.decoder")
TIME_NS = 1_700_000_000_250_000_000


def write(path: Path, *messages: tuple[Any, str, Any]) -> Path:
    with LogWriter(path, views=True) as log:
        for topic, agent, message in messages:
            log.write(topic, agent, "yard", message, TIME_NS)
    return path


def seen_in(path: Path) -> dict[str, tuple[str, Any]]:
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
    found = seen_in(path)
    assert {key: schema for key, (schema, _) in found.items() if key.startswith("foxglove/")} == {
        "foxglove/yard/cam0/calibration": "foxglove.CameraCalibration",
        "foxglove/yard/cam0/annotations": "foxglove.ImageAnnotations",
        "foxglove/yard/transforms": "foxglove.FrameTransforms",
        "foxglove/yard/scene": "foxglove.SceneUpdate",
        "foxglove/yard/points": "foxglove.PointCloud",
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
    transform = seen_in(write(tmp_path / "a.mcap", (CALIBRATION, "hub", message)))["foxglove/yard/transforms"][1]
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
    found = seen_in(write(tmp_path / "a.mcap", (RIG_INFO, "hub", rig), (TRACK, "hub", track())))
    place = found["foxglove/yard/scene"][1].entities[0].spheres[0].pose.position
    assert (place.x, place.y, place.z) == pytest.approx((0.01, 0.02, 0.03))
    arbitrary = calibration()
    arbitrary.units, arbitrary.scale = "cm", "arbitrary"
    found = seen_in(write(tmp_path / "b.mcap", (CALIBRATION, "hub", arbitrary), (TRACK, "hub", track())))
    assert found["foxglove/yard/scene"][1].entities[0].spheres[0].pose.position.x == 1.0


def test_a_lost_track_goes_out_of_the_picture(tmp_path: Path) -> None:
    lost = track()
    lost.state = "lost"
    scene = seen_in(write(tmp_path / "a.mcap", (TRACK, "hub", lost)))["foxglove/yard/scene"][1]
    assert not scene.entities
    assert scene.deletions[0].id == "marker"


def test_a_lens_that_the_hub_found_is_shown_where_the_camera_has_none(tmp_path: Path) -> None:
    bare = camera_info()
    del bare.matrix[:]
    path = write(tmp_path / "a.mcap", (CAMERA_INFO, "cam0", bare), (CALIBRATION, "hub", calibration()))
    lens = seen_in(path)["foxglove/yard/cam0/calibration"][1]
    assert (lens.width, lens.height, lens.distortion_model) == (640, 480, "kannala_brandt")
    empty = seen_in(
        write(tmp_path / "b.mcap", (CALIBRATION, "hub", pb.Calibration(schema_version=1, status="refused")))
    )
    assert list(empty) == ["syncline/yard/hub/hub/calibration"]


def jpeg(width: int, height: int) -> bytes:
    """A real one."""
    good, data = cv2.imencode(".jpg", np.full((height, width, 3), 90, np.uint8))
    assert good
    return data.tobytes()


def test_picture_lens_and_circles_of_a_camera_are_told_in_the_same_pixels(tmp_path: Path) -> None:
    """The middle of the 1280 px wide image is the middle of its 320 px wide picture."""
    shown, info, seen = picture("cam0"), camera_info("cam0"), observation("cam0")
    shown.jpeg = jpeg(320, 180)
    info.width, info.height = 1280, 720
    info.matrix[:] = [1000.0, 0.0, 639.5, 0.0, 1010.0, 359.5, 0.0, 0.0, 1.0]
    detection = seen.detections[0]
    detection.u, detection.v, detection.size = 639.5, 359.5, 40.0
    messages = ((PICTURE, "cam0", shown), (CAMERA_INFO, "cam0", info), (OBSERVATION, "cam0", seen))
    found = seen_in(write(tmp_path / "a.mcap", *messages))
    schema, image = found["foxglove/yard/cam0/image"]
    assert (schema, image.frame_id, image.format, image.data) == (
        "foxglove.CompressedImage",
        "cam0",
        "jpeg",
        shown.jpeg,
    )
    lens = found["foxglove/yard/cam0/calibration"][1]
    assert (lens.frame_id, lens.width, lens.height) == ("cam0", 320, 180)
    assert list(lens.K) == pytest.approx([250.0, 0.0, 159.5, 0.0, 252.5, 89.5, 0.0, 0.0, 1.0])
    circle = found["foxglove/yard/cam0/annotations"][1].circles[0]
    assert (circle.position.x, circle.position.y, circle.diameter) == pytest.approx((159.5, 89.5, 10.0))
    # Restarted with smaller images, before the first picture of them.
    smaller = camera_info("cam0")
    smaller.width, smaller.height = 320, 180
    smaller.matrix[:] = [250.0, 0.0, 159.5, 0.0, 252.5, 89.5, 0.0, 0.0, 1.0]
    detection.u, detection.v, detection.size = 159.5, 89.5, 10.0
    again = (*messages[:2], (CAMERA_INFO, "cam0", smaller), messages[2])
    found = seen_in(write(tmp_path / "b.mcap", *again))
    lens, circle = found["foxglove/yard/cam0/calibration"][1], found["foxglove/yard/cam0/annotations"][1].circles[0]
    assert (lens.width, lens.height, lens.K[0]) == (320, 180, 250.0)
    assert (circle.position.x, circle.position.y, circle.diameter) == pytest.approx((159.5, 89.5, 10.0))


def test_what_is_no_picture_is_kept_but_shown_to_no_viewer(tmp_path: Path) -> None:
    for number, data in enumerate((b"", b"\xff\xd8\xff\xd9", b"not a picture", jpeg(64, 48)[:30])):
        shown = picture("cam0")
        shown.jpeg = data
        found = seen_in(write(tmp_path / f"{number}.mcap", (PICTURE, "cam0", shown)))
        assert list(found) == ["syncline/yard/camera/cam0/picture"]


@pytest.mark.parametrize("options", [[], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1], [cv2.IMWRITE_JPEG_RST_INTERVAL, 2]])
def test_a_jpegs_size_is_read_without_decoding_it(options: list[int]) -> None:
    for width, height in ((320, 180), (7, 1000), (1, 1)):
        good, data = cv2.imencode(".jpg", np.full((height, width, 3), 90, np.uint8), options)
        assert good
        assert jpeg_size(data.tobytes()) == (width, height)


def test_points_are_all_that_were_heard_of_lately(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with LogWriter(path, views=True) as log:
        for after_s, label, state in ((0.0, "ann", "confirmed"), (1.0, "bob", "confirmed"), (2.5, "bob", "confirmed")):
            message = track()
            message.label, message.state, message.position[:] = label, state, [after_s, 2.0, 3.0]
            log.write(TRACK, "hub", "yard", message, TIME_NS + round(after_s * 1e9))
    points = [np.frombuffer(view.data, "<f4").reshape(-1, 3) for view in clouds(path)]
    assert [len(cloud) for cloud in points] == [1, 2, 1], "no message of ann for two seconds"
    np.testing.assert_allclose(points[-1], [[2.5, 2.0, 3.0]])


def clouds(path: Path) -> list[Any]:
    payloads = [item.raw.payload for item in LogReader(path).raw() if item.key == "foxglove/yard/points"]
    return [PointCloud.FromString(payload) for payload in payloads]


def test_a_flight_is_shown_twice_a_second_with_the_car_on_it(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with LogWriter(path, views=True) as log:
        log.write(UAV_INFO, "drone", "yard", SAMPLES[UAV_INFO](), TIME_NS)
        for index in range(30):
            flight, target = SAMPLES[FLIGHT_IMAGE](), SAMPLES[TARGET]()
            flight.agent = target.agent = "drone"
            flight.jpeg = jpeg(flight.width, flight.height)
            log.write(FLIGHT_IMAGE, "drone", "yard", flight, TIME_NS + index * 33_000_000)
            log.write(TARGET, "drone", "yard", target, TIME_NS + index * 33_000_000)
    topics = Counter(item.key.rpartition("/")[2] for item in LogReader(path).raw() if item.key.startswith("foxglove/"))
    assert topics["image"] == 2
    assert topics["annotations"] == 30
    drawn = seen_in(path)["foxglove/yard/drone/annotations"][1]
    target = SAMPLES[TARGET]()
    assert (drawn.circles[0].position.x, drawn.circles[0].position.y) == tuple(target.centre)
    assert drawn.texts[0].text == target.state


def test_the_schemas_are_those_of_foxgloves_own_package() -> None:
    """Every field that we write has the number, name and type that Foxglove's software reads."""
    messages = pytest.importorskip("foxglove.messages", reason="NO FOXGLOVE: pip install foxglove-sdk")

    def fields(data: bytes) -> dict[str, set[tuple[Any, ...]]]:
        found: dict[str, set[tuple[Any, ...]]] = {}

        def walk(prefix: str, kinds: Any) -> None:
            for kind in kinds:
                name = f"{prefix}.{kind.name}"
                found[name] = {(one.number, one.name, one.type, one.label, one.type_name) for one in kind.field}
                walk(name, kind.nested_type)

        for file in FileDescriptorSet.FromString(data).file:
            walk(file.package, file.message_type)
        return found

    for kind in FOXGLOVE_SCHEMAS.values():
        theirs = getattr(messages, kind).get_schema()
        ours = schema_of(f"foxglove/yard/{next(name for name, one in FOXGLOVE_SCHEMAS.items() if one == kind)}")
        assert ours is not None
        assert (ours.name, theirs.encoding) == (theirs.name, "protobuf")
        known = fields(theirs.data)
        for name, parts in fields(ours.data).items():
            assert parts <= known[name], name


def test_our_own_readers_pass_over_what_is_for_viewers(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", (OBSERVATION, "cam0", observation("cam0")), (TRACK, "hub", track()))
    reader = LogReader(path)
    assert [item.topic for item in reader.messages()] == [OBSERVATION, TRACK]
    assert reader.counters == {}
    assert describe_log(path).messages == 2
    assert sum(1 for _ in reader.raw()) == 5
