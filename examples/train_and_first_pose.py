"""First pose: python examples/train_and_first_pose.py mysat.stl mm camera.yaml frame.png"""

import sys

import cv2
import numpy as np

from rendezview import Recognizer, load_camera, train


def main(mesh, unit, camera_file, picture, options=None):
    camera = load_camera(camera_file)
    model = train(mesh, "model.rvm", unit=unit, camera=camera, options=options)  # a few minutes
    found = Recognizer(model, camera).recognize(cv2.imread(picture, cv2.IMREAD_GRAYSCALE))
    print(found.status, found.reason or "")
    if found.pose is not None:
        sigma = np.sqrt(np.diag(found.covariance))
        print("quaternion wxyz:", found.pose.quat_wxyz, "±", np.rad2deg(sigma[:3]), "degrees")
        print("translation:", found.pose.translation_m, "±", sigma[3:], "m, camera frame")
    return found


if __name__ == "__main__":
    main(*sys.argv[1:5])
