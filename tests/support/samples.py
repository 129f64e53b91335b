"""One valid message of every kind, with every field set, and a wait that polls."""

from __future__ import annotations

import time
from collections.abc import Callable

from google.protobuf.message import Message

from protocols.messages import syncline_pb2 as pb
from protocols.topics import (
    CALIBRATION,
    CAMERA_INFO,
    COMMAND,
    FLIGHT_IMAGE,
    NODE_STATE,
    OBSERVATION,
    PART,
    PICTURE,
    PREDICTION,
    RIG_INFO,
    ROAD_MAP,
    SHARD,
    SOLVER_EVENT,
    STATUS,
    TARGET,
    TARGET_CLOUD,
    TARGET_COMMAND,
    TELEMETRY,
    TRACK,
    TRACK_SMOOTHED,
    UAV_INFO,
    Topic,
)

MATRIX = [600.0, 0.0, 319.5, 0.0, 600.0, 239.5, 0.0, 0.0, 1.0]


def observation(camera: str = "cam0", sequence: int = 0, boot_id: str = "boot-1", points: int = 1) -> pb.Observation:
    """One frame in which ``points`` markers were detected."""
    detection = pb.Detection(
        u=320.5,
        v=240.25,
        size=12.5,
        score=0.75,
        label="marker",
        colour=pb.Colour(red=255, green=64),
        covariance=[0.25, 0.01, 0.5],
        kind="person",
        head=[321.0, 210.5],
        foot=[320.0, 290.25],
        box=[300.5, 210.5, 40.0, 80.0],
        target="p7",
    )
    return pb.Observation(
        schema_version=1,
        camera=camera,
        boot_id=boot_id,
        sequence=sequence,
        frame=sequence + 7,
        device_time_ns=-5 + 33_333_333 * sequence,
        exposure_ns=8_000_000,
        detections=[detection] * points,
    )


def camera_info(camera: str = "cam0") -> pb.CameraInfo:
    """A calibrated camera at a known place."""
    return pb.CameraInfo(
        schema_version=1,
        camera=camera,
        boot_id="boot-1",
        width=640,
        height=480,
        fps=30.0,
        matrix=MATRIX,
        distortions=[0.1, -0.05, 0.001, 0.002, 0.01],
        driver="simulated",
        clock="device",
        position=[1.0, 2.0, 3.0],
        rotation=[0.1, 0.2, 0.3],
        position_std=[0.01, 0.01, 0.01],
        rotation_std=[0.01, 0.01, 0.01],
        readout_s=0.02,
    )


def rig_info(distance: float = 3.42) -> pb.RigInfo:
    """A rig whose scale comes from one distance."""
    between = pb.RigInfo.Distance(camera_a="cam0", camera_b="cam1", distance=distance)
    return pb.RigInfo(
        schema_version=1,
        units="m",
        clock="independent",
        distances=[between],
        up=[0.0, 0.0, 1.0],
        up_camera="cam0",
        reference_camera="cam0",
    )


def calibration(revision: int = 1) -> pb.Calibration:
    """One camera solved, one refused."""
    solved = pb.CameraCalibration(
        camera="cam0",
        rotation=[0.1, 0.2, 0.3],
        translation=[1.0, 2.0, 3.0],
        time_offset=-12.5,
        clock_rate=1.00001,
        time_offset_std=1e-4,
        position_std=[0.01, 0.02, 0.03],
        rms_px=0.4,
        matrix=MATRIX,
        distortions=[0.1, 0.0, 0.0, 0.0],
        fisheye=True,
        boot_id="boot-1",
    )
    return pb.Calibration(
        schema_version=1,
        revision=revision,
        status="solved",
        reason="enough was seen",
        reference_camera="cam0",
        scale="metric",
        units="m",
        solver="joint",
        cameras=[solved],
        refused=[pb.Refusal(camera="cam1", reason="nothing moved in its view")],
        progress=[pb.CameraProgress(camera="cam1", state="searching", shared_motion_s=4.0, coverage=0.2, margin=1.5)],
        state="calibrated",
    )


def track(sequence: int = 0) -> pb.Track:
    """One confirmed track."""
    return pb.Track(
        schema_version=1,
        sequence=sequence,
        label="marker",
        state="confirmed",
        reference_time_ns=1_000_000_000,
        position=[1.0, 2.0, 3.0],
        velocity=[0.1, 0.2, 0.3],
        position_covariance=[0.1, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 0.1],
        kind="person",
        heading=-1.5,
        height=1.75,
        height_std=0.02,
        colour=pb.Colour(red=200, green=30, blue=40),
        cameras=3,
        unseen_s=0.05,
        velocity_covariance=[0.1, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 0.1],
    )


def status(agent: str = "cam0", sequence: int = 0) -> pb.AgentStatus:
    """A healthy camera agent."""
    return pb.AgentStatus(
        schema_version=1,
        agent=agent,
        role="camera",
        boot_id="boot-1",
        sequence=sequence,
        state="running",
        message="all is well – über alles",
        counters={"published": 10.0, "refused.blurred": 2.0},
        gauges={"fps": 29.97},
        version="0.1.0",
    )


def node_state(camera: str = "cam0", sequence: int = 0) -> pb.NodeState:
    """A settled pose node with one edge."""
    edge = pb.NodeEdge(
        neighbour="cam1",
        rotation=[0.1, 0.2, 0.3],
        centre=[1.0, 2.0, 3.0],
        hessian=[float(i + 1) for i in range(21)],
        gradient=[0.1] * 6,
        count=96.0,
        bearings=True,
    )
    anchor = pb.NodeAnchor(
        camera="cam2",
        epoch=1,
        sequence=7,
        rotation=[0.1, 0.2, 0.3],
        position=[1.0, 2.0, 3.0],
        world_rotation=[0.3, 0.2, 0.1],
        world_position=[3.0, 2.0, 1.0],
        rotation_std=0.01,
        position_std=0.02,
        aside=True,
    )
    return pb.NodeState(
        schema_version=1,
        camera=camera,
        host="hub",
        takeover=1,
        sequence=sequence,
        epoch=2,
        frame="cam0",
        hops=1,
        depth=2,
        rotation=[0.1, 0.2, 0.3],
        position=[1.0, 2.0, 3.0],
        settled=40,
        partner="cam1",
        leaving=True,
        edges=[edge],
        anchors=[anchor],
    )


def command(sender: str = "cam0", sequence: int = 0) -> pb.Command:
    """What a button in a view sends."""
    return pb.Command(
        schema_version=1,
        sender=sender,
        boot_id="boot-1",
        sequence=sequence,
        action="recalibrate",
        agent="hub",
        agent_boot="b1",
    )


def picture(camera: str = "cam0") -> pb.Picture:
    """A small picture for a view."""
    return pb.Picture(
        schema_version=1,
        camera=camera,
        boot_id="boot-1",
        frame=7,
        device_time_ns=1_000_000_000,
        width=1280,
        height=720,
        jpeg=b"\xff\xd8\xff\xd9",
    )


def prediction(sequence: int = 0) -> pb.Prediction:
    """One target in one camera."""
    target = pb.PredictedTarget(
        target="person-1",
        kind="person",
        u=320.5,
        v=240.25,
        u_velocity=-12.5,
        v_velocity=3.5,
        covariance=[4.0, 0.5, 9.0],
        size=180.0,
        head=[320.0, 150.0],
        foot=[321.0, 330.0],
        face=[310.0, 148.0, 21.0, 26.0],
        view="left",
        colour=pb.Colour(red=200),
    )
    camera = pb.CameraPrediction(camera="cam0", boot_id="boot-1", device_time_ns=-5, targets=[target])
    return pb.Prediction(schema_version=1, sequence=sequence, reference_time_ns=1_000_000_000, cameras=[camera])


def flight_image(agent: str = "cam0", order: int = 0) -> pb.FlightImage:
    """A picture of four bytes."""
    return pb.FlightImage(
        schema_version=1,
        agent=agent,
        boot_id="boot-1",
        order=order,
        frame=7,
        device_time_ns=-5,
        width=640,
        height=480,
        jpeg=b"jpeg",
    )


def vehicle_telemetry(agent: str = "cam0", order: int = 0) -> pb.VehicleTelemetry:
    """A level vehicle 60 m up."""
    return pb.VehicleTelemetry(
        schema_version=1,
        agent=agent,
        boot_id="boot-1",
        order=order,
        device_time_ns=33_000_000,
        vehicle_time_ns=70_000_000_000,
        time_std_s=0.002,
        ned_from_body=[1.0, 0.0, 0.0, 0.0],
        position=[10.0, -4.0, -60.0],
        origin=[47.4, 8.5, 410.0],
    )


def target_command(agent: str = "cam0", order: int = 0) -> pb.TargetCommand:
    """A box drawn by the ground station 255."""
    return pb.TargetCommand(
        schema_version=1,
        agent=agent,
        boot_id="boot-1",
        order=order,
        kind="select",
        box=[10.0, 20.0, 40.0, 20.0],
        by=255,
    )


def target_state(agent: str = "cam0", sequence: int = 0) -> pb.TargetState:
    """A car outside the picture."""
    return pb.TargetState(
        schema_version=1,
        agent=agent,
        boot_id="boot-1",
        sequence=sequence,
        frame=7,
        device_time_ns=33_000_000,
        state="coasting",
        centre=[-20.5, 700.0],
        size=[40.0, 20.0],
        heading=[0.5],
        std_px=12.0,
        ground=[10.0, 20.0],
        velocity=[8.0, -2.0],
        std_m=1.2,
        geo=[47.4, 8.5, 410.0],
        hypotheses=[pb.TargetHypothesis(weight=1.0, x=-20.0, y=700.0)],
    )


def target_cloud(agent: str = "cam0", sequence: int = 0) -> pb.TargetCloud:
    """Two particles."""
    return pb.TargetCloud(
        schema_version=1, agent=agent, boot_id="boot-1", sequence=sequence, particles=400, pixels=[1.0, 2.0, 3.0, 4.0]
    )


def road_map(agent: str = "cam0", sequence: int = 0) -> pb.RoadMap:
    """Two points of a road's outline."""
    return pb.RoadMap(
        schema_version=1,
        agent=agent,
        boot_id="boot-1",
        sequence=sequence,
        pixels=[1.0, 2.0, 3.0, 4.0],
        ground=[10.0, 20.0, 30.0, 40.0],
    )


def uav_info(agent: str = "cam0") -> pb.UavInfo:
    """A camera that looks straight down."""
    return pb.UavInfo(
        schema_version=1,
        agent=agent,
        boot_id="boot-1",
        width=640,
        height=480,
        fps=30.0,
        matrix=MATRIX,
        distortions=[0.1, -0.05, 0.001, 0.002, 0.01],
        body_from_camera=[0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0],
        seed=3,
        model="ground",
    )


def solver_event() -> pb.SolverEvent:
    """A job of a hub's solver."""
    message = pb.SolverEvent(schema_version=1, job=3, kind="submitted", search=True, full=True, cpu_s=0.5)
    message.rows.add(camera="cam0", boot_id="b0", first_sequence=5, last_sequence=90, count=80)
    message.clock_priors.add(camera="cam0", unix_minus_camera=1.5, error_bound=0.01)
    message.arrivals.add(camera="cam0", unix_minus_camera=1.6, error_bound=0.15)
    return message


def shard(hub: str = "cam0") -> pb.Shard:
    """A hub that follows two groups."""
    message = pb.Shard(schema_version=1, hub=hub, version=2)
    message.groups.add(hub=hub, cameras=["cam0", "cam1"])
    message.groups.add(hub="hub-b", cameras=["cam2"])
    message.overlaps.add(camera_a="cam1", camera_b="cam2", seconds=12.5)
    return message


SAMPLES: dict[Topic, Callable[[], Message]] = {
    OBSERVATION: observation,
    CAMERA_INFO: camera_info,
    RIG_INFO: rig_info,
    CALIBRATION: calibration,
    TRACK: track,
    TRACK_SMOOTHED: track,
    SOLVER_EVENT: solver_event,
    STATUS: status,
    NODE_STATE: node_state,
    COMMAND: command,
    PICTURE: picture,
    PREDICTION: prediction,
    FLIGHT_IMAGE: flight_image,
    TELEMETRY: vehicle_telemetry,
    TARGET_COMMAND: target_command,
    TARGET: target_state,
    TARGET_CLOUD: target_cloud,
    ROAD_MAP: road_map,
    UAV_INFO: uav_info,
    PART: calibration,
    SHARD: shard,
}


def eventually(condition: Callable[[], bool], timeout_s: float = 10.0) -> bool:
    """Poll until the condition holds; False when the time is up."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() >= deadline:
            return False
        time.sleep(0.005)
    return True
