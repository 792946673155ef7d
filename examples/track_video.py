"""Draw the axes: python examples/track_video.py model.rvm approach.mp4 camera.yaml drawn.mp4"""

import sys

import cv2

from rendezview import Recognizer, Tracker, ViewModel, load_camera, open_sequence

model, camera = ViewModel.load(sys.argv[1]), load_camera(sys.argv[3])
lens = camera.distortion or (0.0,) * 4
drawn = cv2.VideoWriter(
    sys.argv[4], cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (camera.width, camera.height)
)
tracker = Tracker(Recognizer(model, camera))
for number, frame in enumerate(open_sequence(sys.argv[2], camera)):
    image = frame.read()
    found = tracker.update(float(number), image)
    picture = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    if found.pose is not None:
        turn, place = cv2.Rodrigues(found.pose.rotation)[0], found.pose.translation_m
        cv2.drawFrameAxes(picture, camera.matrix, lens, turn, place, model.target_radius_m)
    drawn.write(picture)
    print(frame.name, found.status, found.reason or found.pose.translation_m)
drawn.release()
