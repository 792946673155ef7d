// Drives ViSP's model-based tracker from a pipe, for visp-driver.
//
//     visp_driver MODEL.cao WIDTH HEIGHT FX FY CX CY [name=value ...]
//
// Settings by name: see `set` below. Requests and answers are packed binary, in the machine's own
// order; a pose is a rotation, row by row, and a translation: 12 doubles, camera from target.
//   F  passes, repeats, pose, frame   start at the pose and track this frame, `passes` times on,
//                                     all of it `repeats` times    -> answer
//   S  pose, frame                    start a sequence: the frame and its pose -> answer
//   N  frame                          the sequence's next frame, from its own last pose -> answer
//   V  pose                           edges in view -> count, then u v u v of each, pixels
// An answer: status (0 a pose, 1 ViSP threw), pose, median seconds of track() on the processor and
// on the wall, edge points in use, length and text of what was thrown.
#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <exception>
#include <string>
#include <vector>

#include <unistd.h>

#include <visp3/mbt/vpMbGenericTracker.h>

namespace
{
// Faces of this name hide what is behind them, and are not tracked.
const char *const SMOOTH = "smooth";
FILE *answers = nullptr;

void take(void *to, std::size_t bytes)
{
  if (bytes > 0 && std::fread(to, bytes, 1, stdin) != 1) {
    std::exit(2);
  }
}

void give(const void *from, std::size_t bytes)
{
  if (bytes > 0 && std::fwrite(from, bytes, 1, answers) != 1) {
    std::exit(3);
  }
}

template <class T> T taken()
{
  T value;
  take(&value, sizeof(value));
  return value;
}

vpHomogeneousMatrix pose_taken()
{
  double numbers[12];
  take(numbers, sizeof(numbers));
  vpHomogeneousMatrix pose;
  for (unsigned int i = 0; i < 3; ++i) {
    for (unsigned int j = 0; j < 3; ++j) {
      pose[i][j] = numbers[3 * i + j];
    }
    pose[i][3] = numbers[9 + i];
  }
  return pose;
}

void give_pose(const vpHomogeneousMatrix &pose)
{
  double numbers[12];
  for (unsigned int i = 0; i < 3; ++i) {
    for (unsigned int j = 0; j < 3; ++j) {
      numbers[3 * i + j] = pose[i][j];
    }
    numbers[9 + i] = pose[i][3];
  }
  give(numbers, sizeof(numbers));
}

double now(clockid_t clock)
{
  timespec time;
  clock_gettime(clock, &time);
  return static_cast<double>(time.tv_sec) + 1e-9 * static_cast<double>(time.tv_nsec);
}

double median(std::vector<double> values)
{
  if (values.empty()) {
    return 0.0;
  }
  std::sort(values.begin(), values.end());
  const std::size_t middle = values.size() / 2;
  return values.size() % 2 == 1 ? values[middle] : 0.5 * (values[middle - 1] + values[middle]);
}

class Driver
{
public:
  explicit Driver(char **arguments, int settings)
      : _frame(number(arguments[3]), number(arguments[2])),
        _camera(std::atof(arguments[4]), std::atof(arguments[5]), std::atof(arguments[6]),
                std::atof(arguments[7])),
        _tracker(1, vpMbGenericTracker::EDGE_TRACKER)
  {
    // every one can be set by name
    _edge.setMaskSize(5);
    _edge.setMaskNumber(180);
    _edge.setRange(10);
    _edge.setThreshold(5000);
    _edge.setMu1(0.5);
    _edge.setMu2(0.5);
    _edge.setSampleStep(4);
    for (int k = 0; k < settings; ++k) {
      const std::string words(arguments[8 + k]);
      const std::size_t sign = words.find('=');
      if (sign == std::string::npos
          || !set(words.substr(0, sign), std::atof(words.c_str() + sign + 1))) {
        std::fprintf(stderr, "unknown setting: %s\n", words.c_str());
        std::exit(4);
      }
    }
    _edge.initMask();
    _tracker.setTrackerType(_is_klt ? vpMbGenericTracker::EDGE_TRACKER | vpMbGenericTracker::KLT_TRACKER
                                    : vpMbGenericTracker::EDGE_TRACKER);
    _tracker.setCameraParameters(_camera);
    _tracker.setMovingEdge(_edge);
    if (_is_klt) {
      vpKltOpencv points;
      points.setMaxFeatures(500);
      points.setWindowSize(7);
      points.setQuality(0.01);
      points.setMinDistance(8);
      points.setHarrisFreeParameter(0.01);
      points.setBlockSize(3);
      points.setPyramidLevels(3);
      _tracker.setKltOpencv(points);
      _tracker.setKltMaskBorder(5);
    }
    _tracker.setAngleAppear(vpMath::rad(_appear_deg));
    _tracker.setAngleDisappear(vpMath::rad(_disappear_deg));
    _tracker.setGoodMovingEdgesRatioThreshold(_good_ratio);
    _tracker.setProjectionErrorComputation(false);
    _tracker.setDisplayFeatures(false);
    _tracker.loadModel(arguments[1]);
    _tracker.setScanLineVisibilityTest(_is_scan_line);
    _tracker.setUseEdgeTracking(SMOOTH, false);
    if (_is_klt) {
      _tracker.setUseKltTracking(SMOOTH, false);  // it takes faces as flat
    }
    if (_is_lm) {
      _tracker.setOptimizationMethod(vpMbTracker::LEVENBERG_MARQUARDT_OPT);
    }
  }

  void frame()
  {
    const std::uint32_t passes = taken<std::uint32_t>();
    const std::uint32_t repeats = taken<std::uint32_t>();
    const vpHomogeneousMatrix start = pose_taken();
    _last = start;
    take(_frame.bitmap, _frame.getSize());
    for (std::uint32_t repeat = 0; repeat < repeats && _thrown.empty(); ++repeat) {
      attempt([&] {
        _tracker.initFromPose(_frame, start);
        timed([&] {
          for (std::uint32_t pass = 0; pass < passes; ++pass) {
            _tracker.track(_frame);
          }
        });
      });
    }
    answer();
  }

  void start()
  {
    _last = pose_taken();
    take(_frame.bitmap, _frame.getSize());
    attempt([&] { _tracker.initFromPose(_frame, _last); });
    answer();
  }

  void next()
  {
    take(_frame.bitmap, _frame.getSize());
    attempt([&] { timed([&] { _tracker.track(_frame); }); });
    if (!_thrown.empty()) {
      const std::string first = _thrown;  // it may find the target again from where it was
      attempt([&] { _tracker.initFromPose(_frame, _last); });
      _thrown = first;
    }
    answer();
  }

  void view()
  {
    const vpHomogeneousMatrix pose = pose_taken();
    _tracker.initFromPose(_frame, pose);  // asks what is hidden, from just there
    const auto lines = _tracker.getModelForDisplay(_frame.getWidth(), _frame.getHeight(), pose,
                                                   _camera, false);
    std::vector<double> ends;
    for (const auto &line : lines) {
      if (line.size() >= 5 && line[0] == 0.0) {  // 0: a straight one, then i j i j
        ends.insert(ends.end(), {line[2], line[1], line[4], line[3]});
      }
    }
    const std::uint32_t count = static_cast<std::uint32_t>(ends.size() / 4);
    give(&count, sizeof(count));
    give(ends.data(), ends.size() * sizeof(double));
  }

private:
  static unsigned int number(const char *text) { return static_cast<unsigned int>(std::atoi(text)); }

  bool set(const std::string &name, double value)
  {
    const unsigned int whole = static_cast<unsigned int>(value);
    if (name == "range") _edge.setRange(whole);                        // pixels to each side
    else if (name == "threshold") _edge.setThreshold(value);           // likelihood of an edge
    else if (name == "mu1") _edge.setMu1(value);                       // least contrast kept
    else if (name == "mu2") _edge.setMu2(value);                       // most contrast kept
    else if (name == "step") _edge.setSampleStep(value);               // pixels between points
    else if (name == "mask") _edge.setMaskSize(whole);                 // pixels of the masks
    else if (name == "appear") _appear_deg = value;
    else if (name == "disappear") _disappear_deg = value;
    else if (name == "good") _good_ratio = value;                      // least share of points kept
    else if (name == "scanline") _is_scan_line = value != 0.0;
    else if (name == "lm") _is_lm = value != 0.0;                      // Levenberg–Marquardt
    else if (name == "klt") _is_klt = value != 0.0;
    else return false;
    return true;
  }

  template <class Call> void attempt(Call call)
  {
    try {
      call();
    } catch (const std::exception &error) {  // vpException is one
      _thrown = error.what();
      if (_thrown.empty()) {
        _thrown = "an exception without words";
      }
    }
  }

  template <class Call> void timed(Call call)
  {
    const double processor = now(CLOCK_PROCESS_CPUTIME_ID), wall = now(CLOCK_MONOTONIC);
    const auto stop = [&] {
      _processor_s.push_back(now(CLOCK_PROCESS_CPUTIME_ID) - processor);
      _wall_s.push_back(now(CLOCK_MONOTONIC) - wall);
    };
    try {
      call();
    } catch (...) {  // it has cost its time all the same
      stop();
      throw;
    }
    stop();
  }

  void answer()
  {
    const std::int32_t status = _thrown.empty() ? 0 : 1;
    if (status == 0) {
      _last = _tracker.getPose();
    }
    const double spent_s[2] = {median(_processor_s), median(_wall_s)};
    const std::uint32_t points = status == 0 ? _tracker.getNbPoints() : 0;
    const std::uint32_t letters = static_cast<std::uint32_t>(_thrown.size());
    give(&status, sizeof(status));
    give_pose(_last);
    give(spent_s, sizeof(spent_s));
    give(&points, sizeof(points));
    give(&letters, sizeof(letters));
    give(_thrown.data(), letters);
    _thrown.clear();
    _processor_s.clear();
    _wall_s.clear();
  }

  vpImage<unsigned char> _frame;
  vpCameraParameters _camera;
  vpMbGenericTracker _tracker;
  vpMe _edge;
  vpHomogeneousMatrix _last;
  std::vector<double> _processor_s, _wall_s;
  std::string _thrown;
  double _appear_deg = 85.0, _disappear_deg = 89.0, _good_ratio = 0.4;
  bool _is_scan_line = true, _is_lm = false, _is_klt = false;
};
}  // namespace

int main(int count, char **arguments)
{
  if (count < 8) {
    std::fprintf(stderr, "visp_driver MODEL.cao WIDTH HEIGHT FX FY CX CY [name=value ...]\n");
    return 4;
  }
  // ViSP prints to the standard output what it has read; answers must not mix with that
  answers = fdopen(dup(STDOUT_FILENO), "wb");
  if (answers == nullptr || dup2(STDERR_FILENO, STDOUT_FILENO) < 0) {
    return 3;
  }
  try {
    Driver driver(arguments, count - 8);
    for (int request = std::getchar(); request != EOF; request = std::getchar()) {
      switch (request) {
      case 'F': driver.frame(); break;
      case 'S': driver.start(); break;
      case 'N': driver.next(); break;
      case 'V': driver.view(); break;
      default: return 5;
      }
      std::fflush(answers);
    }
  } catch (const std::exception &error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 1;
  }
  return 0;
}
