"""Train a model of a mesh (a few minutes), then find its pose in one picture.

python examples/train_and_first_pose.py mysat.stl mm camera.yaml frame.png
"""

import sys

import cv2
import numpy as np

from rendezview.api import Observation, Recognizer, TrainingOptions, load_camera, train


def main(
    mesh: str, unit: str, camera_file: str, picture: str, options: TrainingOptions | None = None
) -> Observation:
    camera = load_camera(camera_file)
    model = train(mesh, "model.rvm", unit=unit, camera=camera, options=options)
    found = Recognizer(model, camera).recognize(cv2.imread(picture, cv2.IMREAD_GRAYSCALE))
    print(found.status, found.reason or "")
    if found.pose is not None and found.covariance is not None:
        sigma = np.sqrt(np.diag(found.covariance))
        print("quaternion w x y z:", found.pose.quat_wxyz, "±", np.rad2deg(sigma[:3]), "degrees")
        print("translation:", found.pose.translation_m, "±", sigma[3:], "m, camera frame")
    return found


if __name__ == "__main__":
    main(*sys.argv[1:5])
