"""Predicted detections from the hub's multi-target tracker, received for one camera's detector."""

from __future__ import annotations

from edge.detectors.base import Prediction
from protocols.bus.base import Subscription
from protocols.core.clocks import NANOSECONDS
from protocols.messages import syncline_pb2 as pb

_MAX_AGE_S = 0.5  # a prediction farther away in time is not used for a frame
_VELOCITY_STD = 60.0  # px/s, std of a target's deviation from the predicted image velocity


class PredictionSubscriber:
    """Keeps the newest prediction of each hub for one camera in its current boot."""

    def __init__(self, subscription: Subscription, camera: str, boot_id: str) -> None:
        self._subscription = subscription
        self._camera = camera
        self._boot_id = boot_id
        self._newest: dict[str, pb.CameraPrediction] = {}

    def at(self, device_time_ns: int) -> list[Prediction]:
        """Predictions extrapolated to a frame at ``device_time_ns`` on the camera's clock."""
        for received in self._subscription.drain():
            message = received.message
            if isinstance(message, pb.Prediction):
                for one in message.cameras:
                    if one.camera == self._camera and one.boot_id in ("", self._boot_id):
                        self._newest[received.agent] = one
        expected = []
        for one in self._newest.values():
            ahead = (device_time_ns - one.device_time_ns) / NANOSECONDS
            if abs(ahead) <= _MAX_AGE_S:
                expected += [_prediction(target, ahead) for target in one.targets if target.target]
        return expected

    def close(self) -> None:
        """Close the subscription."""
        self._subscription.close()


def _prediction(target: pb.PredictedTarget, ahead: float) -> Prediction:
    uu, uv, vv = target.covariance or (400.0, 0.0, 400.0)
    more = (_VELOCITY_STD * ahead) ** 2
    colour = target.colour
    return Prediction(
        u=target.u + ahead * target.u_velocity,
        v=target.v + ahead * target.v_velocity,
        covariance=(uu + more, uv, vv + more),
        target=target.target,
        size=target.size,
        colour=(colour.red, colour.green, colour.blue) if target.HasField("colour") else None,
    )
