// Poses by the edges of a model, with ViSP's generic tracker: each line of the standard input names
// a picture and a pose to start from, by rows; the answer is a pose, or "lost".
#include <iostream>
#include <visp3/io/vpImageIo.h>
#include <visp3/mbt/vpMbGenericTracker.h>

int main(int count, char **given)
{
  if (count != 6) {
    std::cerr << "MODEL.cao fx fy cx cy\n";
    return 2;
  }
  vpMbGenericTracker tracker(1, vpMbGenericTracker::EDGE_TRACKER);
  vpMe edges;
  edges.setMaskSize(5);
  edges.setMaskNumber(180);
  edges.setRange(20);       // px; of 12, 20 and 30 the best on the photographs that are published
  edges.setThreshold(5000); // of 1000, 5000 and 10000 the best there
  edges.setMu1(0.5);
  edges.setMu2(0.5);
  edges.setSampleStep(4);
  tracker.setMovingEdge(edges);
  tracker.setCameraParameters(
    vpCameraParameters(atof(given[2]), atof(given[3]), atof(given[4]), atof(given[5])));
  tracker.setAngleAppear(vpMath::rad(85.0));
  tracker.setAngleDisappear(vpMath::rad(89.0));
  tracker.loadModel(given[1]);
  std::string picture;
  while (std::cin >> picture) {
    vpImage<unsigned char> image;
    vpImageIo::read(image, picture);
    vpHomogeneousMatrix pose;
    for (unsigned k = 0; k < 12; ++k)
      std::cin >> pose[k / 4][k % 4];
    try {
      tracker.initFromPose(image, pose);
      for (int round = 0; round < 8; ++round)
        tracker.track(image);
      pose = tracker.getPose();
      std::cout.precision(12);
      for (unsigned k = 0; k < 12; ++k)
        std::cout << pose[k / 4][k % 4] << (k == 11 ? "\n" : " ");
    }
    catch (const vpException &) {
      std::cout << "lost\n";
    }
  }
}
