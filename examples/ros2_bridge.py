"""A ROS 2 node between a camera's topics and the pose service.

    source /opt/ros/jazzy/setup.bash
    python examples/ros2_bridge.py --service http://127.0.0.1:8360 --image /camera/image_raw \\
        --info /camera/camera_info

Frames go from ``sensor_msgs/Image`` (mono8, rgb8 or bgr8) to the service by a stream, the newest
first; what comes back is published as ``geometry_msgs/PoseWithCovarianceStamped`` on
``~/pose`` and as a transform from the camera's frame to ``--target-frame``. Frames without a pose
publish nothing; their reason goes to the node's log. ROS is needed only to run this, not by
rendezview. The conversions need no ROS and are tested without it.
"""

from __future__ import annotations

import argparse
import threading
from typing import Any

import numpy as np

from rendezview.geometry.camera import Camera
from rendezview_service.client import Client, ServiceError

_FROM_OURS = (3, 4, 5, 0, 1, 2)  # ROS has the translation first


def camera_from_info(info: Any) -> Camera:
    """The camera of a ``sensor_msgs/CameraInfo``; its pixels are counted as ours."""
    if info.distortion_model not in ("", "plumb_bob", "rational_polynomial"):
        raise ValueError(f"lens model {info.distortion_model!r}: undistort the images first")
    k = [float(value) for value in info.k]
    distortion = tuple(float(value) for value in info.d)
    return Camera(
        int(info.width), int(info.height), k[0], k[4], k[2], k[5],
        distortion if any(distortion) else (),
    )  # fmt: skip


def grey_from_image(image: Any) -> np.ndarray:
    """(H, W) uint8 of a ``sensor_msgs/Image``, for any row length."""
    channels = {"mono8": 1, "8UC1": 1, "rgb8": 3, "bgr8": 3}.get(image.encoding)
    if channels is None:
        raise ValueError(f"encoding {image.encoding!r}: publish mono8, rgb8 or bgr8")
    rows = np.frombuffer(bytes(image.data), np.uint8).reshape(image.height, image.step)
    pixels = rows[:, : image.width * channels].reshape(image.height, image.width, channels)
    if channels == 1:
        return np.ascontiguousarray(pixels[:, :, 0])
    weights = np.array([0.299, 0.587, 0.114])
    if image.encoding == "bgr8":
        weights = weights[::-1]
    return np.rint(pixels @ weights).astype(np.uint8)


def fill_pose(message: Any, state: dict[str, Any]) -> None:
    """Pose and covariance of a state into a ``geometry_msgs/PoseWithCovariance``."""
    x, y, z = state["pose"]["translation_m"]
    w, qx, qy, qz = state["pose"]["quat_wxyz"]
    place, turn = message.pose.position, message.pose.orientation
    place.x, place.y, place.z = x, y, z
    turn.w, turn.x, turn.y, turn.z = w, qx, qy, qz
    covariance = np.array(state["covariance"])[np.ix_(_FROM_OURS, _FROM_OURS)]
    message.covariance = covariance.ravel().tolist()


def main() -> None:
    """Run the node until it is stopped."""
    import rclpy
    from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
    from rclpy.node import Node
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import CameraInfo, Image
    from tf2_ros import TransformBroadcaster

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--service", default="http://127.0.0.1:8360")
    parser.add_argument("--token")
    parser.add_argument("--model")
    parser.add_argument("--image", default="/camera/image_raw")
    parser.add_argument("--info", default="/camera/camera_info")
    parser.add_argument("--target-frame", default="target")
    arguments, ros_arguments = parser.parse_known_args()

    class Bridge(Node):  # type: ignore[misc]
        """Frames to the service, poses from it."""

        def __init__(self) -> None:
            super().__init__("rendezview")
            self.client = Client(arguments.service, arguments.token)
            self.stream: Any = None
            self.stamps: dict[float, Any] = {}
            self.poses = self.create_publisher(PoseWithCovarianceStamped, "~/pose", 10)
            self.transforms = TransformBroadcaster(self)
            self.create_subscription(CameraInfo, arguments.info, self.on_info, 10)
            self.create_subscription(Image, arguments.image, self.on_image, qos_profile_sensor_data)

        def on_info(self, info: Any) -> None:
            if self.stream is not None:
                return
            session = self.client.open(camera_from_info(info), model=arguments.model)
            self.stream = session.stream()
            threading.Thread(target=self.receive, daemon=True).start()
            self.get_logger().info(f"session {session.name}")

        def on_image(self, image: Any) -> None:
            if self.stream is None:
                return
            stamp = image.header.stamp
            time_s = stamp.sec + 1e-9 * stamp.nanosec
            self.stamps[time_s] = image.header
            while len(self.stamps) > 100:  # of frames that newer ones replaced
                self.stamps.pop(next(iter(self.stamps)))
            self.stream.send(grey_from_image(image), time_s)

        def receive(self) -> None:
            while True:
                try:
                    state = self.stream.receive()
                except ServiceError as error:
                    self.get_logger().warning(str(error))
                    continue
                header = self.stamps.pop(state["time_s"], None)
                if state["pose"] is None:
                    self.get_logger().info(f"{state['status']}: {state['reason']}")
                elif header is not None:
                    self.publish(header, state)

        def publish(self, header: Any, state: dict[str, Any]) -> None:
            pose = PoseWithCovarianceStamped(header=header)
            fill_pose(pose.pose, state)
            self.poses.publish(pose)
            transform = TransformStamped(header=header, child_frame_id=arguments.target_frame)
            place, turn = pose.pose.pose.position, pose.pose.pose.orientation
            moved = transform.transform.translation
            moved.x, moved.y, moved.z = place.x, place.y, place.z
            transform.transform.rotation = turn
            self.transforms.sendTransform(transform)

    rclpy.init(args=ros_arguments)
    node = Bridge()
    try:
        rclpy.spin(node)
    finally:
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    main()
