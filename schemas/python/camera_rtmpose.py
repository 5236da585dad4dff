#!/usr/bin/env python3
"""A camera node with RTMPose: images of a webcam, a stream or a video file in, 2D keypoints on the bus.

    pip install "../..[bus]" opencv-python rtmlib onnxruntime
    python camera_rtmpose.py --video 0 --camera cam_1                            # a webcam
    python camera_rtmpose.py --video rtsp://10.0.0.7/live --camera cam_2 --delay 120
    START=$(($(date +%s) + 20))                                                  # the same for all files of a take
    python camera_rtmpose.py --video cam3.mp4 --camera cam_3 --start $START      # a file, in real time

Run one for each camera. The node needs the calibration: set `rig` in its
settings. `--stored take.mcap` publishes the keypoints of a recording instead of those of a model.
"""

import argparse
import collections
import os
import signal
import sys
import threading
import time

from bundlemocap import Error, bus

# Seconds before a camera that is away is opened again: doubled each time.
FIRST_WAIT, LONGEST_WAIT = 0.5, 8.0
# Seconds that the end waits for a camera that gives no image.
LONGEST_READ = 5.0


class StreamClock:
    """Capture times from a camera's own times, which do not jitter as arrivals do. The least delay of the last seconds tells
    how far its clock is from that of this computer. Cameras without times, and times that only count images at a nominal
    rate, do not keep pace with the arrivals: then it is the arrival."""

    SPAN_NS, DRIFT_NS = 10_000_000_000, 5_000_000

    def __init__(self):
        self._own_ns, self._delays = 0, collections.deque()

    def __call__(self, own_ns, arrival_ns):
        if own_ns <= self._own_ns:
            self._delays.clear()
        self._own_ns = own_ns
        self._delays.append((arrival_ns, arrival_ns - own_ns))
        while len(self._delays) > 1 and arrival_ns - self._delays[1][0] >= self.SPAN_NS:
            self._delays.popleft()
        if arrival_ns - self._delays[0][0] < self.SPAN_NS:
            return arrival_ns
        middle = arrival_ns - self.SPAN_NS // 2
        early, late = (min(delay for at, delay in self._delays if (at < middle) == is_early) for is_early in (True, False))
        return arrival_ns if abs(late - early) > self.DRIFT_NS else own_ns + min(early, late)


class Source:
    """The images of a camera, read by a thread. The iterator gives the newest image; older ones that were not taken are
    dropped and counted. A camera that gives no images is opened again until it does; a file ends."""

    def __init__(self, video, open_capture, start_ns=None, delay_ns=0, say=print):
        self.is_file = os.path.isfile(video)
        self._video, self._open, self._say = video, open_capture, say
        self._start_ns, self._delay_ns = start_ns, delay_ns
        self.images, self.dropped, self.times_away = 0, 0, 0
        self._newest, self._changed, self._ended = None, threading.Condition(), threading.Event()
        self._thread = threading.Thread(target=self._read, daemon=True)

    def __iter__(self):
        """Number, capture time in nanoseconds, image."""
        self._thread.start()
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._newest is not None or self._ended.is_set())
                newest, self._newest = self._newest, None
            if newest is None:
                # Python cannot end in order while the thread is in cv2.
                self._thread.join(LONGEST_READ)
                return
            yield newest

    def is_waiting(self):
        """Whether cv2 still waits for an image of a camera that is away."""
        return self._thread.is_alive()

    def stop(self):
        with self._changed:
            self._ended.set()
            self._changed.notify()

    def _read(self):
        try:
            wait, away_since = FIRST_WAIT, None
            while not self._ended.is_set():
                capture = self._open(self._video)
                before = self.images
                if capture is not None:
                    if away_since is not None:
                        self._say(f"{self._video}: back after {time.monotonic() - away_since:.1f} s")
                        away_since = None
                    self._read_from(capture)
                    capture.release()
                if self.is_file or self._ended.is_set():
                    break
                if away_since is None:
                    self._say(f"{self._video}: gives no images; it is opened again until it does")
                    self.times_away, away_since = self.times_away + 1, time.monotonic()
                wait = FIRST_WAIT if self.images > before else min(2 * wait, LONGEST_WAIT)
                self._ended.wait(wait)
        finally:
            self.stop()

    def _read_from(self, capture):
        import cv2

        rate, clock = capture.get(cv2.CAP_PROP_FPS) or 30.0, StreamClock()
        while not self._ended.is_set() and capture.grab():
            arrival_ns = time.time_ns()
            if self.is_file:
                if self._start_ns is None:
                    self._start_ns = arrival_ns
                # The file's own times; some containers have none.
                seconds = capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3 or self.images / rate
                capture_ns = self._start_ns + round(seconds * 1e9)
                if self._ended.wait(max(0, capture_ns - time.time_ns()) * 1e-9):
                    return
            else:
                own_ns = round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
                capture_ns = clock(own_ns, arrival_ns) - self._delay_ns
            is_whole, image = capture.retrieve()
            number, self.images = self.images, self.images + 1
            if not is_whole:
                self.dropped += 1
                continue
            with self._changed:
                self.dropped += self._newest is not None
                self._newest = number, capture_ns, image
                self._changed.notify()


def open_capture(video):
    """An open cv2.VideoCapture, or None."""
    import cv2

    capture = cv2.VideoCapture(int(video) if video.isdigit() else video)
    # Old images in a buffer would have wrong times.
    capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    return capture if capture.isOpened() else None


class Rtmpose:
    """RTMPose by rtmlib, which loads the weights of the model the first time."""

    FORMATS = {"body": "coco_17", "feet": "halpe_26", "wholebody": "coco_wholebody_133"}

    def __init__(self, model, mode, backend, device):
        try:
            import rtmlib
        except ImportError:
            raise SystemExit("rtmlib is not installed: pip install rtmlib onnxruntime; or use --stored")
        kind = {"body": rtmlib.Body, "feet": rtmlib.BodyWithFeet, "wholebody": rtmlib.Wholebody}[model]
        self._model = kind(mode=mode, backend=backend, device=device)
        self.format = self.FORMATS[model]

    def __call__(self, _, image):
        boxes = self._model.det_model(image)
        # Without boxes rtmlib would take the whole image for a person.
        if len(boxes) == 0:
            return []
        points, scores = self._model.pose_model(image, bboxes=boxes)
        people = zip(points.tolist(), scores.tolist())
        return [[(x, y, max(score, 0.0)) for (x, y), score in zip(*person)] for person in people]


class Stored:
    """The keypoints of a camera in a recording, by the number of the image, as if a model had found them."""

    def __init__(self, recording, camera):
        _, frames = bus.recorded(recording)
        all_cameras = min((frame.frame for frame in frames), default=0)
        frames = [frame for frame in frames if frame.camera == camera]
        if not frames:
            raise SystemExit(f"{recording}: no keypoints of {camera}")
        self.format = frames[0].format
        # Live, each camera may have a counter of its own.
        first = min(frame.frame for frame in frames)
        first = all_cameras if first - all_cameras < 100 else first
        self._people = {
            frame.frame - first: [bus.triples(person.points) for person in frame.people] for frame in frames
        }

    def __call__(self, number, _):
        return self._people.get(number, [])


def run(source, detect, publish, report_seconds, say):
    """Detects and publishes until the source ends. `publish(people, capture_time_ns, number, size)`."""
    begin = last = time.monotonic()
    published, busy, people = 0, 0.0, []

    def report():
        seconds = max(time.monotonic() - begin, 1e-9)
        say(
            f"{source.images} images, {published} published, {source.dropped} dropped, {published / seconds:.1f} a"
            f" second, detection {1e3 * busy / max(published, 1):.0f} ms, people: {len(people)}"
        )

    for number, capture_ns, image in source:
        before = time.monotonic()
        people = detect(number, image)
        busy += time.monotonic() - before
        height, width = image.shape[:2]
        publish(people, capture_ns, number, (width, height))
        published += 1
        if time.monotonic() - last >= report_seconds:
            last = time.monotonic()
            report()
    report()


def main():
    parser = argparse.ArgumentParser(
        description="Publishes the 2D keypoints of a camera.",
        epilog="A millisecond of error in the capture times is 0.8 mm at a walking hand: measure --delay, or let the "
        "node estimate the differences of the cameras.",
    )
    add = parser.add_argument
    add("--video", required=True, help="number of a webcam, address of a stream (rtsp://...), or file")
    add("--camera", required=True, help="its name in the calibration")
    add("--connect", default="tcp/127.0.0.1:7447", help="address of the node")
    add("--stage", default="stage", help="name of the capture volume")
    add("--model", default="feet", choices=Rtmpose.FORMATS, help="the body, with feet, or with hands and face too")
    add("--mode", default="balanced", choices=["performance", "balanced", "lightweight"], help="size of the model")
    add("--backend", default="onnxruntime", choices=["onnxruntime", "opencv", "openvino"])
    add("--device", default="cpu", help="cpu, cuda, mps ...")
    add("--delay", type=float, default=0.0, metavar="MS", help="from the middle of the exposure to the image's arrival")
    add("--start", type=float, metavar="SECONDS", help="time of a file's first image, since 1970; default: now")
    add("--stored", metavar="MCAP", help="take this camera's keypoints in a recording instead of a model's")
    add("--report", type=float, default=10.0, metavar="SECONDS", help="time between two lines of counts")
    args = parser.parse_args()
    if not (args.video.isdigit() or "://" in args.video or os.path.exists(args.video)):
        parser.error(f"--video {args.video}: no such file; a webcam has a number, a stream begins with rtsp:// or alike")
    if args.stored:
        detect = Stored(args.stored, args.camera)
    else:
        detect = Rtmpose(args.model, args.mode, args.backend, args.device)
    say = lambda text: print(f"{args.camera}: {text}", flush=True)
    start_ns = None if args.start is None else round(args.start * 1e9)
    source = Source(args.video, open_capture, start_ns, round(args.delay * 1e6), say)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: source.stop())
    with bus.open_session(args.connect) as session:
        node = None

        def publish(people, capture_ns, number, size):
            nonlocal node
            if node is None or node.size != size:
                node = bus.CameraNode(session, args.camera, size, detect.format, args.stage)
            node.publish(people, capture_ns, number)

        run(source, detect, publish, args.report, say)
    if source.is_file and source.images == 0:
        sys.exit(f"{args.video}: no image can be read")
    if source.is_waiting():
        os._exit(0)


if __name__ == "__main__":
    try:
        main()
    except Error as error:
        raise SystemExit(str(error)) from None
