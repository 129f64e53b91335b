from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Colour(_message.Message):
    __slots__ = ("red", "green", "blue")
    RED_FIELD_NUMBER: _ClassVar[int]
    GREEN_FIELD_NUMBER: _ClassVar[int]
    BLUE_FIELD_NUMBER: _ClassVar[int]
    red: int
    green: int
    blue: int
    def __init__(self, red: _Optional[int] = ..., green: _Optional[int] = ..., blue: _Optional[int] = ...) -> None: ...

class Detection(_message.Message):
    __slots__ = ("u", "v", "size", "score", "label", "colour", "covariance", "kind", "head", "foot", "box", "target")
    U_FIELD_NUMBER: _ClassVar[int]
    V_FIELD_NUMBER: _ClassVar[int]
    SIZE_FIELD_NUMBER: _ClassVar[int]
    SCORE_FIELD_NUMBER: _ClassVar[int]
    LABEL_FIELD_NUMBER: _ClassVar[int]
    COLOUR_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    HEAD_FIELD_NUMBER: _ClassVar[int]
    FOOT_FIELD_NUMBER: _ClassVar[int]
    BOX_FIELD_NUMBER: _ClassVar[int]
    TARGET_FIELD_NUMBER: _ClassVar[int]
    u: float
    v: float
    size: float
    score: float
    label: str
    colour: Colour
    covariance: _containers.RepeatedScalarFieldContainer[float]
    kind: str
    head: _containers.RepeatedScalarFieldContainer[float]
    foot: _containers.RepeatedScalarFieldContainer[float]
    box: _containers.RepeatedScalarFieldContainer[float]
    target: str
    def __init__(self, u: _Optional[float] = ..., v: _Optional[float] = ..., size: _Optional[float] = ..., score: _Optional[float] = ..., label: _Optional[str] = ..., colour: _Optional[_Union[Colour, _Mapping]] = ..., covariance: _Optional[_Iterable[float]] = ..., kind: _Optional[str] = ..., head: _Optional[_Iterable[float]] = ..., foot: _Optional[_Iterable[float]] = ..., box: _Optional[_Iterable[float]] = ..., target: _Optional[str] = ...) -> None: ...

class Observation(_message.Message):
    __slots__ = ("schema_version", "camera", "boot_id", "sequence", "frame", "device_time_ns", "exposure_ns", "detections")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    DEVICE_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    EXPOSURE_NS_FIELD_NUMBER: _ClassVar[int]
    DETECTIONS_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    camera: str
    boot_id: str
    sequence: int
    frame: int
    device_time_ns: int
    exposure_ns: int
    detections: _containers.RepeatedCompositeFieldContainer[Detection]
    def __init__(self, schema_version: _Optional[int] = ..., camera: _Optional[str] = ..., boot_id: _Optional[str] = ..., sequence: _Optional[int] = ..., frame: _Optional[int] = ..., device_time_ns: _Optional[int] = ..., exposure_ns: _Optional[int] = ..., detections: _Optional[_Iterable[_Union[Detection, _Mapping]]] = ...) -> None: ...

class CameraInfo(_message.Message):
    __slots__ = ("schema_version", "camera", "boot_id", "width", "height", "fps", "matrix", "distortions", "fisheye", "driver", "clock", "position", "rotation", "position_std", "rotation_std", "readout_s", "target", "focal_std")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    FPS_FIELD_NUMBER: _ClassVar[int]
    MATRIX_FIELD_NUMBER: _ClassVar[int]
    DISTORTIONS_FIELD_NUMBER: _ClassVar[int]
    FISHEYE_FIELD_NUMBER: _ClassVar[int]
    DRIVER_FIELD_NUMBER: _ClassVar[int]
    CLOCK_FIELD_NUMBER: _ClassVar[int]
    POSITION_FIELD_NUMBER: _ClassVar[int]
    ROTATION_FIELD_NUMBER: _ClassVar[int]
    POSITION_STD_FIELD_NUMBER: _ClassVar[int]
    ROTATION_STD_FIELD_NUMBER: _ClassVar[int]
    READOUT_S_FIELD_NUMBER: _ClassVar[int]
    TARGET_FIELD_NUMBER: _ClassVar[int]
    FOCAL_STD_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    camera: str
    boot_id: str
    width: int
    height: int
    fps: float
    matrix: _containers.RepeatedScalarFieldContainer[float]
    distortions: _containers.RepeatedScalarFieldContainer[float]
    fisheye: bool
    driver: str
    clock: str
    position: _containers.RepeatedScalarFieldContainer[float]
    rotation: _containers.RepeatedScalarFieldContainer[float]
    position_std: _containers.RepeatedScalarFieldContainer[float]
    rotation_std: _containers.RepeatedScalarFieldContainer[float]
    readout_s: float
    target: str
    focal_std: float
    def __init__(self, schema_version: _Optional[int] = ..., camera: _Optional[str] = ..., boot_id: _Optional[str] = ..., width: _Optional[int] = ..., height: _Optional[int] = ..., fps: _Optional[float] = ..., matrix: _Optional[_Iterable[float]] = ..., distortions: _Optional[_Iterable[float]] = ..., fisheye: _Optional[bool] = ..., driver: _Optional[str] = ..., clock: _Optional[str] = ..., position: _Optional[_Iterable[float]] = ..., rotation: _Optional[_Iterable[float]] = ..., position_std: _Optional[_Iterable[float]] = ..., rotation_std: _Optional[_Iterable[float]] = ..., readout_s: _Optional[float] = ..., target: _Optional[str] = ..., focal_std: _Optional[float] = ...) -> None: ...

class RigInfo(_message.Message):
    __slots__ = ("schema_version", "units", "clock", "distances", "up", "up_camera", "reference_camera")
    class Distance(_message.Message):
        __slots__ = ("camera_a", "camera_b", "distance")
        CAMERA_A_FIELD_NUMBER: _ClassVar[int]
        CAMERA_B_FIELD_NUMBER: _ClassVar[int]
        DISTANCE_FIELD_NUMBER: _ClassVar[int]
        camera_a: str
        camera_b: str
        distance: float
        def __init__(self, camera_a: _Optional[str] = ..., camera_b: _Optional[str] = ..., distance: _Optional[float] = ...) -> None: ...
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    UNITS_FIELD_NUMBER: _ClassVar[int]
    CLOCK_FIELD_NUMBER: _ClassVar[int]
    DISTANCES_FIELD_NUMBER: _ClassVar[int]
    UP_FIELD_NUMBER: _ClassVar[int]
    UP_CAMERA_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_CAMERA_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    units: str
    clock: str
    distances: _containers.RepeatedCompositeFieldContainer[RigInfo.Distance]
    up: _containers.RepeatedScalarFieldContainer[float]
    up_camera: str
    reference_camera: str
    def __init__(self, schema_version: _Optional[int] = ..., units: _Optional[str] = ..., clock: _Optional[str] = ..., distances: _Optional[_Iterable[_Union[RigInfo.Distance, _Mapping]]] = ..., up: _Optional[_Iterable[float]] = ..., up_camera: _Optional[str] = ..., reference_camera: _Optional[str] = ...) -> None: ...

class CameraCalibration(_message.Message):
    __slots__ = ("camera", "rotation", "translation", "time_offset", "clock_rate", "time_offset_std", "position_std", "rms_px", "matrix", "distortions", "fisheye", "boot_id", "lag_time_s", "clock_rate_std")
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    ROTATION_FIELD_NUMBER: _ClassVar[int]
    TRANSLATION_FIELD_NUMBER: _ClassVar[int]
    TIME_OFFSET_FIELD_NUMBER: _ClassVar[int]
    CLOCK_RATE_FIELD_NUMBER: _ClassVar[int]
    TIME_OFFSET_STD_FIELD_NUMBER: _ClassVar[int]
    POSITION_STD_FIELD_NUMBER: _ClassVar[int]
    RMS_PX_FIELD_NUMBER: _ClassVar[int]
    MATRIX_FIELD_NUMBER: _ClassVar[int]
    DISTORTIONS_FIELD_NUMBER: _ClassVar[int]
    FISHEYE_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    LAG_TIME_S_FIELD_NUMBER: _ClassVar[int]
    CLOCK_RATE_STD_FIELD_NUMBER: _ClassVar[int]
    camera: str
    rotation: _containers.RepeatedScalarFieldContainer[float]
    translation: _containers.RepeatedScalarFieldContainer[float]
    time_offset: float
    clock_rate: float
    time_offset_std: float
    position_std: _containers.RepeatedScalarFieldContainer[float]
    rms_px: float
    matrix: _containers.RepeatedScalarFieldContainer[float]
    distortions: _containers.RepeatedScalarFieldContainer[float]
    fisheye: bool
    boot_id: str
    lag_time_s: float
    clock_rate_std: float
    def __init__(self, camera: _Optional[str] = ..., rotation: _Optional[_Iterable[float]] = ..., translation: _Optional[_Iterable[float]] = ..., time_offset: _Optional[float] = ..., clock_rate: _Optional[float] = ..., time_offset_std: _Optional[float] = ..., position_std: _Optional[_Iterable[float]] = ..., rms_px: _Optional[float] = ..., matrix: _Optional[_Iterable[float]] = ..., distortions: _Optional[_Iterable[float]] = ..., fisheye: _Optional[bool] = ..., boot_id: _Optional[str] = ..., lag_time_s: _Optional[float] = ..., clock_rate_std: _Optional[float] = ...) -> None: ...

class CameraProgress(_message.Message):
    __slots__ = ("camera", "state", "shared_motion_s", "coverage", "margin", "reason")
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    SHARED_MOTION_S_FIELD_NUMBER: _ClassVar[int]
    COVERAGE_FIELD_NUMBER: _ClassVar[int]
    MARGIN_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    camera: str
    state: str
    shared_motion_s: float
    coverage: float
    margin: float
    reason: str
    def __init__(self, camera: _Optional[str] = ..., state: _Optional[str] = ..., shared_motion_s: _Optional[float] = ..., coverage: _Optional[float] = ..., margin: _Optional[float] = ..., reason: _Optional[str] = ...) -> None: ...

class Refusal(_message.Message):
    __slots__ = ("camera", "reason")
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    camera: str
    reason: str
    def __init__(self, camera: _Optional[str] = ..., reason: _Optional[str] = ...) -> None: ...

class Calibration(_message.Message):
    __slots__ = ("schema_version", "revision", "status", "reason", "reference_camera", "scale", "units", "solver", "cameras", "refused", "progress", "state")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    REVISION_FIELD_NUMBER: _ClassVar[int]
    STATUS_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_CAMERA_FIELD_NUMBER: _ClassVar[int]
    SCALE_FIELD_NUMBER: _ClassVar[int]
    UNITS_FIELD_NUMBER: _ClassVar[int]
    SOLVER_FIELD_NUMBER: _ClassVar[int]
    CAMERAS_FIELD_NUMBER: _ClassVar[int]
    REFUSED_FIELD_NUMBER: _ClassVar[int]
    PROGRESS_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    revision: int
    status: str
    reason: str
    reference_camera: str
    scale: str
    units: str
    solver: str
    cameras: _containers.RepeatedCompositeFieldContainer[CameraCalibration]
    refused: _containers.RepeatedCompositeFieldContainer[Refusal]
    progress: _containers.RepeatedCompositeFieldContainer[CameraProgress]
    state: str
    def __init__(self, schema_version: _Optional[int] = ..., revision: _Optional[int] = ..., status: _Optional[str] = ..., reason: _Optional[str] = ..., reference_camera: _Optional[str] = ..., scale: _Optional[str] = ..., units: _Optional[str] = ..., solver: _Optional[str] = ..., cameras: _Optional[_Iterable[_Union[CameraCalibration, _Mapping]]] = ..., refused: _Optional[_Iterable[_Union[Refusal, _Mapping]]] = ..., progress: _Optional[_Iterable[_Union[CameraProgress, _Mapping]]] = ..., state: _Optional[str] = ...) -> None: ...

class SolverEvent(_message.Message):
    __slots__ = ("schema_version", "job", "kind", "rows", "clock_priors", "reason", "cpu_s", "arrivals", "search", "full", "verify", "refine_lenses")
    class Rows(_message.Message):
        __slots__ = ("camera", "boot_id", "first_sequence", "last_sequence", "count")
        CAMERA_FIELD_NUMBER: _ClassVar[int]
        BOOT_ID_FIELD_NUMBER: _ClassVar[int]
        FIRST_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
        LAST_SEQUENCE_FIELD_NUMBER: _ClassVar[int]
        COUNT_FIELD_NUMBER: _ClassVar[int]
        camera: str
        boot_id: str
        first_sequence: int
        last_sequence: int
        count: int
        def __init__(self, camera: _Optional[str] = ..., boot_id: _Optional[str] = ..., first_sequence: _Optional[int] = ..., last_sequence: _Optional[int] = ..., count: _Optional[int] = ...) -> None: ...
    class ClockPrior(_message.Message):
        __slots__ = ("camera", "unix_minus_camera", "error_bound")
        CAMERA_FIELD_NUMBER: _ClassVar[int]
        UNIX_MINUS_CAMERA_FIELD_NUMBER: _ClassVar[int]
        ERROR_BOUND_FIELD_NUMBER: _ClassVar[int]
        camera: str
        unix_minus_camera: float
        error_bound: float
        def __init__(self, camera: _Optional[str] = ..., unix_minus_camera: _Optional[float] = ..., error_bound: _Optional[float] = ...) -> None: ...
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    JOB_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    ROWS_FIELD_NUMBER: _ClassVar[int]
    CLOCK_PRIORS_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    CPU_S_FIELD_NUMBER: _ClassVar[int]
    ARRIVALS_FIELD_NUMBER: _ClassVar[int]
    SEARCH_FIELD_NUMBER: _ClassVar[int]
    FULL_FIELD_NUMBER: _ClassVar[int]
    VERIFY_FIELD_NUMBER: _ClassVar[int]
    REFINE_LENSES_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    job: int
    kind: str
    rows: _containers.RepeatedCompositeFieldContainer[SolverEvent.Rows]
    clock_priors: _containers.RepeatedCompositeFieldContainer[SolverEvent.ClockPrior]
    reason: str
    cpu_s: float
    arrivals: _containers.RepeatedCompositeFieldContainer[SolverEvent.ClockPrior]
    search: bool
    full: bool
    verify: bool
    refine_lenses: bool
    def __init__(self, schema_version: _Optional[int] = ..., job: _Optional[int] = ..., kind: _Optional[str] = ..., rows: _Optional[_Iterable[_Union[SolverEvent.Rows, _Mapping]]] = ..., clock_priors: _Optional[_Iterable[_Union[SolverEvent.ClockPrior, _Mapping]]] = ..., reason: _Optional[str] = ..., cpu_s: _Optional[float] = ..., arrivals: _Optional[_Iterable[_Union[SolverEvent.ClockPrior, _Mapping]]] = ..., search: _Optional[bool] = ..., full: _Optional[bool] = ..., verify: _Optional[bool] = ..., refine_lenses: _Optional[bool] = ...) -> None: ...

class Track(_message.Message):
    __slots__ = ("schema_version", "sequence", "label", "state", "reference_time_ns", "position", "velocity", "position_covariance", "kind", "heading", "height", "height_std", "colour", "cameras", "unseen_s", "velocity_covariance")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    LABEL_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    POSITION_FIELD_NUMBER: _ClassVar[int]
    VELOCITY_FIELD_NUMBER: _ClassVar[int]
    POSITION_COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    HEADING_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_STD_FIELD_NUMBER: _ClassVar[int]
    COLOUR_FIELD_NUMBER: _ClassVar[int]
    CAMERAS_FIELD_NUMBER: _ClassVar[int]
    UNSEEN_S_FIELD_NUMBER: _ClassVar[int]
    VELOCITY_COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    sequence: int
    label: str
    state: str
    reference_time_ns: int
    position: _containers.RepeatedScalarFieldContainer[float]
    velocity: _containers.RepeatedScalarFieldContainer[float]
    position_covariance: _containers.RepeatedScalarFieldContainer[float]
    kind: str
    heading: float
    height: float
    height_std: float
    colour: Colour
    cameras: int
    unseen_s: float
    velocity_covariance: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, schema_version: _Optional[int] = ..., sequence: _Optional[int] = ..., label: _Optional[str] = ..., state: _Optional[str] = ..., reference_time_ns: _Optional[int] = ..., position: _Optional[_Iterable[float]] = ..., velocity: _Optional[_Iterable[float]] = ..., position_covariance: _Optional[_Iterable[float]] = ..., kind: _Optional[str] = ..., heading: _Optional[float] = ..., height: _Optional[float] = ..., height_std: _Optional[float] = ..., colour: _Optional[_Union[Colour, _Mapping]] = ..., cameras: _Optional[int] = ..., unseen_s: _Optional[float] = ..., velocity_covariance: _Optional[_Iterable[float]] = ...) -> None: ...

class AgentStatus(_message.Message):
    __slots__ = ("schema_version", "agent", "role", "boot_id", "sequence", "state", "message", "counters", "gauges", "version")
    class CountersEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    class GaugesEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    AGENT_FIELD_NUMBER: _ClassVar[int]
    ROLE_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    COUNTERS_FIELD_NUMBER: _ClassVar[int]
    GAUGES_FIELD_NUMBER: _ClassVar[int]
    VERSION_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    agent: str
    role: str
    boot_id: str
    sequence: int
    state: str
    message: str
    counters: _containers.ScalarMap[str, float]
    gauges: _containers.ScalarMap[str, float]
    version: str
    def __init__(self, schema_version: _Optional[int] = ..., agent: _Optional[str] = ..., role: _Optional[str] = ..., boot_id: _Optional[str] = ..., sequence: _Optional[int] = ..., state: _Optional[str] = ..., message: _Optional[str] = ..., counters: _Optional[_Mapping[str, float]] = ..., gauges: _Optional[_Mapping[str, float]] = ..., version: _Optional[str] = ...) -> None: ...

class NodeEdge(_message.Message):
    __slots__ = ("neighbour", "rotation", "centre", "hessian", "gradient", "count", "bearings", "chi2")
    NEIGHBOUR_FIELD_NUMBER: _ClassVar[int]
    ROTATION_FIELD_NUMBER: _ClassVar[int]
    CENTRE_FIELD_NUMBER: _ClassVar[int]
    HESSIAN_FIELD_NUMBER: _ClassVar[int]
    GRADIENT_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    BEARINGS_FIELD_NUMBER: _ClassVar[int]
    CHI2_FIELD_NUMBER: _ClassVar[int]
    neighbour: str
    rotation: _containers.RepeatedScalarFieldContainer[float]
    centre: _containers.RepeatedScalarFieldContainer[float]
    hessian: _containers.RepeatedScalarFieldContainer[float]
    gradient: _containers.RepeatedScalarFieldContainer[float]
    count: float
    bearings: bool
    chi2: float
    def __init__(self, neighbour: _Optional[str] = ..., rotation: _Optional[_Iterable[float]] = ..., centre: _Optional[_Iterable[float]] = ..., hessian: _Optional[_Iterable[float]] = ..., gradient: _Optional[_Iterable[float]] = ..., count: _Optional[float] = ..., bearings: _Optional[bool] = ..., chi2: _Optional[float] = ...) -> None: ...

class NodeAnchor(_message.Message):
    __slots__ = ("camera", "epoch", "sequence", "rotation", "position", "world_rotation", "world_position", "rotation_std", "position_std", "aside")
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    ROTATION_FIELD_NUMBER: _ClassVar[int]
    POSITION_FIELD_NUMBER: _ClassVar[int]
    WORLD_ROTATION_FIELD_NUMBER: _ClassVar[int]
    WORLD_POSITION_FIELD_NUMBER: _ClassVar[int]
    ROTATION_STD_FIELD_NUMBER: _ClassVar[int]
    POSITION_STD_FIELD_NUMBER: _ClassVar[int]
    ASIDE_FIELD_NUMBER: _ClassVar[int]
    camera: str
    epoch: int
    sequence: int
    rotation: _containers.RepeatedScalarFieldContainer[float]
    position: _containers.RepeatedScalarFieldContainer[float]
    world_rotation: _containers.RepeatedScalarFieldContainer[float]
    world_position: _containers.RepeatedScalarFieldContainer[float]
    rotation_std: float
    position_std: float
    aside: bool
    def __init__(self, camera: _Optional[str] = ..., epoch: _Optional[int] = ..., sequence: _Optional[int] = ..., rotation: _Optional[_Iterable[float]] = ..., position: _Optional[_Iterable[float]] = ..., world_rotation: _Optional[_Iterable[float]] = ..., world_position: _Optional[_Iterable[float]] = ..., rotation_std: _Optional[float] = ..., position_std: _Optional[float] = ..., aside: _Optional[bool] = ...) -> None: ...

class NodeState(_message.Message):
    __slots__ = ("schema_version", "camera", "host", "takeover", "sequence", "epoch", "frame", "hops", "depth", "rotation", "position", "settled", "partner", "leaving", "edges", "anchors")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    HOST_FIELD_NUMBER: _ClassVar[int]
    TAKEOVER_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    HOPS_FIELD_NUMBER: _ClassVar[int]
    DEPTH_FIELD_NUMBER: _ClassVar[int]
    ROTATION_FIELD_NUMBER: _ClassVar[int]
    POSITION_FIELD_NUMBER: _ClassVar[int]
    SETTLED_FIELD_NUMBER: _ClassVar[int]
    PARTNER_FIELD_NUMBER: _ClassVar[int]
    LEAVING_FIELD_NUMBER: _ClassVar[int]
    EDGES_FIELD_NUMBER: _ClassVar[int]
    ANCHORS_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    camera: str
    host: str
    takeover: int
    sequence: int
    epoch: int
    frame: str
    hops: int
    depth: int
    rotation: _containers.RepeatedScalarFieldContainer[float]
    position: _containers.RepeatedScalarFieldContainer[float]
    settled: int
    partner: str
    leaving: bool
    edges: _containers.RepeatedCompositeFieldContainer[NodeEdge]
    anchors: _containers.RepeatedCompositeFieldContainer[NodeAnchor]
    def __init__(self, schema_version: _Optional[int] = ..., camera: _Optional[str] = ..., host: _Optional[str] = ..., takeover: _Optional[int] = ..., sequence: _Optional[int] = ..., epoch: _Optional[int] = ..., frame: _Optional[str] = ..., hops: _Optional[int] = ..., depth: _Optional[int] = ..., rotation: _Optional[_Iterable[float]] = ..., position: _Optional[_Iterable[float]] = ..., settled: _Optional[int] = ..., partner: _Optional[str] = ..., leaving: _Optional[bool] = ..., edges: _Optional[_Iterable[_Union[NodeEdge, _Mapping]]] = ..., anchors: _Optional[_Iterable[_Union[NodeAnchor, _Mapping]]] = ...) -> None: ...

class Command(_message.Message):
    __slots__ = ("schema_version", "sender", "boot_id", "sequence", "action", "agent", "agent_boot")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    SENDER_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    ACTION_FIELD_NUMBER: _ClassVar[int]
    AGENT_FIELD_NUMBER: _ClassVar[int]
    AGENT_BOOT_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    sender: str
    boot_id: str
    sequence: int
    action: str
    agent: str
    agent_boot: str
    def __init__(self, schema_version: _Optional[int] = ..., sender: _Optional[str] = ..., boot_id: _Optional[str] = ..., sequence: _Optional[int] = ..., action: _Optional[str] = ..., agent: _Optional[str] = ..., agent_boot: _Optional[str] = ...) -> None: ...

class Picture(_message.Message):
    __slots__ = ("schema_version", "camera", "boot_id", "frame", "device_time_ns", "width", "height", "jpeg")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    DEVICE_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    JPEG_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    camera: str
    boot_id: str
    frame: int
    device_time_ns: int
    width: int
    height: int
    jpeg: bytes
    def __init__(self, schema_version: _Optional[int] = ..., camera: _Optional[str] = ..., boot_id: _Optional[str] = ..., frame: _Optional[int] = ..., device_time_ns: _Optional[int] = ..., width: _Optional[int] = ..., height: _Optional[int] = ..., jpeg: _Optional[bytes] = ...) -> None: ...

class PredictedTarget(_message.Message):
    __slots__ = ("target", "kind", "u", "v", "u_velocity", "v_velocity", "covariance", "size", "head", "foot", "face", "view", "colour")
    TARGET_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    U_FIELD_NUMBER: _ClassVar[int]
    V_FIELD_NUMBER: _ClassVar[int]
    U_VELOCITY_FIELD_NUMBER: _ClassVar[int]
    V_VELOCITY_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    SIZE_FIELD_NUMBER: _ClassVar[int]
    HEAD_FIELD_NUMBER: _ClassVar[int]
    FOOT_FIELD_NUMBER: _ClassVar[int]
    FACE_FIELD_NUMBER: _ClassVar[int]
    VIEW_FIELD_NUMBER: _ClassVar[int]
    COLOUR_FIELD_NUMBER: _ClassVar[int]
    target: str
    kind: str
    u: float
    v: float
    u_velocity: float
    v_velocity: float
    covariance: _containers.RepeatedScalarFieldContainer[float]
    size: float
    head: _containers.RepeatedScalarFieldContainer[float]
    foot: _containers.RepeatedScalarFieldContainer[float]
    face: _containers.RepeatedScalarFieldContainer[float]
    view: str
    colour: Colour
    def __init__(self, target: _Optional[str] = ..., kind: _Optional[str] = ..., u: _Optional[float] = ..., v: _Optional[float] = ..., u_velocity: _Optional[float] = ..., v_velocity: _Optional[float] = ..., covariance: _Optional[_Iterable[float]] = ..., size: _Optional[float] = ..., head: _Optional[_Iterable[float]] = ..., foot: _Optional[_Iterable[float]] = ..., face: _Optional[_Iterable[float]] = ..., view: _Optional[str] = ..., colour: _Optional[_Union[Colour, _Mapping]] = ...) -> None: ...

class CameraPrediction(_message.Message):
    __slots__ = ("camera", "boot_id", "device_time_ns", "targets")
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    DEVICE_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    TARGETS_FIELD_NUMBER: _ClassVar[int]
    camera: str
    boot_id: str
    device_time_ns: int
    targets: _containers.RepeatedCompositeFieldContainer[PredictedTarget]
    def __init__(self, camera: _Optional[str] = ..., boot_id: _Optional[str] = ..., device_time_ns: _Optional[int] = ..., targets: _Optional[_Iterable[_Union[PredictedTarget, _Mapping]]] = ...) -> None: ...

class Prediction(_message.Message):
    __slots__ = ("schema_version", "sequence", "reference_time_ns", "cameras")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    CAMERAS_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    sequence: int
    reference_time_ns: int
    cameras: _containers.RepeatedCompositeFieldContainer[CameraPrediction]
    def __init__(self, schema_version: _Optional[int] = ..., sequence: _Optional[int] = ..., reference_time_ns: _Optional[int] = ..., cameras: _Optional[_Iterable[_Union[CameraPrediction, _Mapping]]] = ...) -> None: ...

class FlightImage(_message.Message):
    __slots__ = ("schema_version", "agent", "boot_id", "order", "frame", "device_time_ns", "width", "height", "jpeg")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    AGENT_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    ORDER_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    DEVICE_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    JPEG_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    agent: str
    boot_id: str
    order: int
    frame: int
    device_time_ns: int
    width: int
    height: int
    jpeg: bytes
    def __init__(self, schema_version: _Optional[int] = ..., agent: _Optional[str] = ..., boot_id: _Optional[str] = ..., order: _Optional[int] = ..., frame: _Optional[int] = ..., device_time_ns: _Optional[int] = ..., width: _Optional[int] = ..., height: _Optional[int] = ..., jpeg: _Optional[bytes] = ...) -> None: ...

class VehicleTelemetry(_message.Message):
    __slots__ = ("schema_version", "agent", "boot_id", "order", "device_time_ns", "vehicle_time_ns", "time_std_s", "ned_from_body", "position", "origin", "position_std")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    AGENT_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    ORDER_FIELD_NUMBER: _ClassVar[int]
    DEVICE_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    VEHICLE_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    TIME_STD_S_FIELD_NUMBER: _ClassVar[int]
    NED_FROM_BODY_FIELD_NUMBER: _ClassVar[int]
    POSITION_FIELD_NUMBER: _ClassVar[int]
    ORIGIN_FIELD_NUMBER: _ClassVar[int]
    POSITION_STD_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    agent: str
    boot_id: str
    order: int
    device_time_ns: int
    vehicle_time_ns: int
    time_std_s: float
    ned_from_body: _containers.RepeatedScalarFieldContainer[float]
    position: _containers.RepeatedScalarFieldContainer[float]
    origin: _containers.RepeatedScalarFieldContainer[float]
    position_std: float
    def __init__(self, schema_version: _Optional[int] = ..., agent: _Optional[str] = ..., boot_id: _Optional[str] = ..., order: _Optional[int] = ..., device_time_ns: _Optional[int] = ..., vehicle_time_ns: _Optional[int] = ..., time_std_s: _Optional[float] = ..., ned_from_body: _Optional[_Iterable[float]] = ..., position: _Optional[_Iterable[float]] = ..., origin: _Optional[_Iterable[float]] = ..., position_std: _Optional[float] = ...) -> None: ...

class TargetCommand(_message.Message):
    __slots__ = ("schema_version", "agent", "boot_id", "order", "kind", "box", "by")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    AGENT_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    ORDER_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    BOX_FIELD_NUMBER: _ClassVar[int]
    BY_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    agent: str
    boot_id: str
    order: int
    kind: str
    box: _containers.RepeatedScalarFieldContainer[float]
    by: int
    def __init__(self, schema_version: _Optional[int] = ..., agent: _Optional[str] = ..., boot_id: _Optional[str] = ..., order: _Optional[int] = ..., kind: _Optional[str] = ..., box: _Optional[_Iterable[float]] = ..., by: _Optional[int] = ...) -> None: ...

class TargetHypothesis(_message.Message):
    __slots__ = ("weight", "x", "y")
    WEIGHT_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    weight: float
    x: float
    y: float
    def __init__(self, weight: _Optional[float] = ..., x: _Optional[float] = ..., y: _Optional[float] = ...) -> None: ...

class TargetState(_message.Message):
    __slots__ = ("schema_version", "agent", "boot_id", "sequence", "frame", "device_time_ns", "state", "centre", "size", "heading", "std_px", "ground", "velocity", "std_m", "geo", "hypotheses")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    AGENT_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    DEVICE_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    CENTRE_FIELD_NUMBER: _ClassVar[int]
    SIZE_FIELD_NUMBER: _ClassVar[int]
    HEADING_FIELD_NUMBER: _ClassVar[int]
    STD_PX_FIELD_NUMBER: _ClassVar[int]
    GROUND_FIELD_NUMBER: _ClassVar[int]
    VELOCITY_FIELD_NUMBER: _ClassVar[int]
    STD_M_FIELD_NUMBER: _ClassVar[int]
    GEO_FIELD_NUMBER: _ClassVar[int]
    HYPOTHESES_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    agent: str
    boot_id: str
    sequence: int
    frame: int
    device_time_ns: int
    state: str
    centre: _containers.RepeatedScalarFieldContainer[float]
    size: _containers.RepeatedScalarFieldContainer[float]
    heading: _containers.RepeatedScalarFieldContainer[float]
    std_px: float
    ground: _containers.RepeatedScalarFieldContainer[float]
    velocity: _containers.RepeatedScalarFieldContainer[float]
    std_m: float
    geo: _containers.RepeatedScalarFieldContainer[float]
    hypotheses: _containers.RepeatedCompositeFieldContainer[TargetHypothesis]
    def __init__(self, schema_version: _Optional[int] = ..., agent: _Optional[str] = ..., boot_id: _Optional[str] = ..., sequence: _Optional[int] = ..., frame: _Optional[int] = ..., device_time_ns: _Optional[int] = ..., state: _Optional[str] = ..., centre: _Optional[_Iterable[float]] = ..., size: _Optional[_Iterable[float]] = ..., heading: _Optional[_Iterable[float]] = ..., std_px: _Optional[float] = ..., ground: _Optional[_Iterable[float]] = ..., velocity: _Optional[_Iterable[float]] = ..., std_m: _Optional[float] = ..., geo: _Optional[_Iterable[float]] = ..., hypotheses: _Optional[_Iterable[_Union[TargetHypothesis, _Mapping]]] = ...) -> None: ...

class TargetCloud(_message.Message):
    __slots__ = ("schema_version", "agent", "boot_id", "sequence", "frame", "device_time_ns", "particles", "pixels")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    AGENT_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    DEVICE_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    PARTICLES_FIELD_NUMBER: _ClassVar[int]
    PIXELS_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    agent: str
    boot_id: str
    sequence: int
    frame: int
    device_time_ns: int
    particles: int
    pixels: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, schema_version: _Optional[int] = ..., agent: _Optional[str] = ..., boot_id: _Optional[str] = ..., sequence: _Optional[int] = ..., frame: _Optional[int] = ..., device_time_ns: _Optional[int] = ..., particles: _Optional[int] = ..., pixels: _Optional[_Iterable[float]] = ...) -> None: ...

class RoadMap(_message.Message):
    __slots__ = ("schema_version", "agent", "boot_id", "sequence", "frame", "device_time_ns", "pixels", "ground")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    AGENT_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    DEVICE_TIME_NS_FIELD_NUMBER: _ClassVar[int]
    PIXELS_FIELD_NUMBER: _ClassVar[int]
    GROUND_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    agent: str
    boot_id: str
    sequence: int
    frame: int
    device_time_ns: int
    pixels: _containers.RepeatedScalarFieldContainer[float]
    ground: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, schema_version: _Optional[int] = ..., agent: _Optional[str] = ..., boot_id: _Optional[str] = ..., sequence: _Optional[int] = ..., frame: _Optional[int] = ..., device_time_ns: _Optional[int] = ..., pixels: _Optional[_Iterable[float]] = ..., ground: _Optional[_Iterable[float]] = ...) -> None: ...

class UavInfo(_message.Message):
    __slots__ = ("schema_version", "agent", "boot_id", "width", "height", "fps", "matrix", "distortions", "fisheye", "body_from_camera", "seed", "model")
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    AGENT_FIELD_NUMBER: _ClassVar[int]
    BOOT_ID_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    FPS_FIELD_NUMBER: _ClassVar[int]
    MATRIX_FIELD_NUMBER: _ClassVar[int]
    DISTORTIONS_FIELD_NUMBER: _ClassVar[int]
    FISHEYE_FIELD_NUMBER: _ClassVar[int]
    BODY_FROM_CAMERA_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    MODEL_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    agent: str
    boot_id: str
    width: int
    height: int
    fps: float
    matrix: _containers.RepeatedScalarFieldContainer[float]
    distortions: _containers.RepeatedScalarFieldContainer[float]
    fisheye: bool
    body_from_camera: _containers.RepeatedScalarFieldContainer[float]
    seed: int
    model: str
    def __init__(self, schema_version: _Optional[int] = ..., agent: _Optional[str] = ..., boot_id: _Optional[str] = ..., width: _Optional[int] = ..., height: _Optional[int] = ..., fps: _Optional[float] = ..., matrix: _Optional[_Iterable[float]] = ..., distortions: _Optional[_Iterable[float]] = ..., fisheye: _Optional[bool] = ..., body_from_camera: _Optional[_Iterable[float]] = ..., seed: _Optional[int] = ..., model: _Optional[str] = ...) -> None: ...

class Shard(_message.Message):
    __slots__ = ("schema_version", "hub", "version", "groups", "overlaps")
    class Overlap(_message.Message):
        __slots__ = ("camera_a", "camera_b", "seconds")
        CAMERA_A_FIELD_NUMBER: _ClassVar[int]
        CAMERA_B_FIELD_NUMBER: _ClassVar[int]
        SECONDS_FIELD_NUMBER: _ClassVar[int]
        camera_a: str
        camera_b: str
        seconds: float
        def __init__(self, camera_a: _Optional[str] = ..., camera_b: _Optional[str] = ..., seconds: _Optional[float] = ...) -> None: ...
    class Group(_message.Message):
        __slots__ = ("hub", "cameras")
        HUB_FIELD_NUMBER: _ClassVar[int]
        CAMERAS_FIELD_NUMBER: _ClassVar[int]
        hub: str
        cameras: _containers.RepeatedScalarFieldContainer[str]
        def __init__(self, hub: _Optional[str] = ..., cameras: _Optional[_Iterable[str]] = ...) -> None: ...
    SCHEMA_VERSION_FIELD_NUMBER: _ClassVar[int]
    HUB_FIELD_NUMBER: _ClassVar[int]
    VERSION_FIELD_NUMBER: _ClassVar[int]
    GROUPS_FIELD_NUMBER: _ClassVar[int]
    OVERLAPS_FIELD_NUMBER: _ClassVar[int]
    schema_version: int
    hub: str
    version: int
    groups: _containers.RepeatedCompositeFieldContainer[Shard.Group]
    overlaps: _containers.RepeatedCompositeFieldContainer[Shard.Overlap]
    def __init__(self, schema_version: _Optional[int] = ..., hub: _Optional[str] = ..., version: _Optional[int] = ..., groups: _Optional[_Iterable[_Union[Shard.Group, _Mapping]]] = ..., overlaps: _Optional[_Iterable[_Union[Shard.Overlap, _Mapping]]] = ...) -> None: ...
