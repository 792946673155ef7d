"""Track a target through a video or a folder of pictures, and draw its axes into a new video.

python examples/track_video.py model.rvm approach.mp4 camera.yaml drawn.mp4
"""

import sys

import cv2

from rendezview.api import Recognizer, Tracker, ViewModel, load_camera, open_sequence


def main(model_file: str, video: str, camera_file: str, output: str) -> int:
    model, camera, poses = ViewModel.load(model_file), load_camera(camera_file), 0
    size = (camera.width, camera.height)
    drawn = cv2.VideoWriter(output, cv2.VideoWriter.fourcc(*"mp4v"), 10.0, size)
    tracker = Tracker(Recognizer(model, camera))
    for number, frame in enumerate(open_sequence(video, camera)):
        image = frame.read()
        found = tracker.update(number if frame.time_s is None else frame.time_s, image)
        picture = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
        if found.pose is not None:
            turn, lens = cv2.Rodrigues(found.pose.rotation)[0], (*camera.distortion, *[0.0] * 4)
            length = model.target_radius_m
            cv2.drawFrameAxes(picture, camera.matrix, lens, turn, found.pose.translation_m, length)
            poses += 1
        cv2.putText(picture, found.status, (10, 30), cv2.FONT_HERSHEY_SIMPLEX, 1, (255, 255, 255))
        drawn.write(picture)
    drawn.release()
    print(f"{output}: {poses} poses in {number + 1} frames")
    return poses


if __name__ == "__main__":
    main(*sys.argv[1:5])
