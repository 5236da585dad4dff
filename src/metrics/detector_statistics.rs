//! Statistics of a detector's errors: on a real recording against its solution, or on a synthetic
//! one against its truth or its solution, so that the two can be compared.
//!
//! Residuals are detected minus projected, divided by the person's height in that image (the
//! larger side of the box around the projected joints), so they do not depend on distance and
//! resolution. Against a solution they hold the errors of detector, calibration and clocks that the
//! fit did not absorb; a fair comparison solves both recordings.

use nalgebra::Vector2;

use super::statistics::{mean, median, percentiles};
use crate::core::body::{BodyPoint, Posture, Skeleton, fitted_points};
use crate::core::camera::{Camera, Rig};
use crate::core::detections::{Detection, Detections, Keypoint, KeypointFormat, Person};
use crate::core::time::Timestamp;

/// Samples in a segment of the spectrum.
const PIECE: usize = 32;
/// Samples from one segment's start to the next.
const HOP: usize = PIECE / 2;
/// Samples further apart than this are on two sides of a gap, periods.
const GAP_PERIODS: f64 = 1.5;
/// A detected person is the performer if the median residual is below this share of the height.
const GATE: f64 = 0.25;
/// Number of confidence bins between 0 and 1.
const BINS: usize = 10;

/// One point in one frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Seen {
    /// Detected minus projected, divided by the person's height in the image.
    pub residual: Vector2<f64>,
    /// Confidence of the detection.
    pub confidence: f64,
}

/// One point of one camera over time.
#[derive(Clone, Debug, PartialEq)]
pub struct PointTrack {
    /// Index of the camera in the rig.
    pub camera: usize,
    /// The keypoint.
    pub keypoint: Keypoint,
    /// Time in seconds and the detection, frame by frame; `None` where the detector has the
    /// performer without this point and the projection lies in the image.
    pub samples: Vec<(f64, Option<Seen>)>,
}

/// Tracks of the points of all cameras, and counts of frames and limb pairs.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DetectorTracks {
    /// Tracks of the fitted points of each camera.
    pub tracks: Vec<PointTrack>,
    /// Frames of all cameras that were compared.
    pub frames: usize,
    /// Frames without a person near the projected body.
    pub without_performer: usize,
    /// Frames with another person beside the performer, or with the performer detected twice.
    pub with_others: usize,
    /// Pairs of limb points (elbows, wrists, knees, ankles) far enough apart to be distinguished.
    pub pairs: usize,
    /// Pairs among them that fit better with left and right exchanged.
    pub inverted: usize,
}

/// Points with a confidence in one bin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ConfidenceBin {
    /// Lower and upper end.
    pub range: [f64; 2],
    /// Share of all detected points.
    pub share: f64,
    /// Median size of the residual, as a share of the height; 0 for an empty bin.
    pub median_error: f64,
    /// Mean size of the residual, as a share of the height; 0 for an empty bin.
    pub mean_error: f64,
}

/// Statistics of a detector. Sizes are shares of the person's height.
#[derive(Clone, Debug, PartialEq)]
pub struct DetectorStatistics {
    /// Number of detected points.
    pub points: usize,
    /// Median size of the residuals.
    pub residual_median: f64,
    /// 95th percentile of their size.
    pub residual_p95: f64,
    /// Systematic error: median over the tracks of the size of a track's median residual.
    pub systematic: f64,
    /// Varying error: median size of residual minus the track's median residual.
    pub varying: f64,
    /// Median size of second differences of the residual between neighbouring frames.
    pub second_difference: f64,
    /// Share of the points missing while the performer is seen.
    pub missing: f64,
    /// Mean length of a run of missing frames, seconds.
    pub missing_run_s: f64,
    /// Share of frames without the performer.
    pub without_performer: f64,
    /// Share of frames with others, or with the performer detected twice.
    pub with_others: f64,
    /// Share of limb pairs that fit better with left and right exchanged.
    pub inverted: f64,
    /// Spectrum of the residuals: frequency in hertz, and median over tracks and segments of
    /// the power in share^2 per hertz, both axes summed. Segments have 32 frames without a gap, are
    /// centred and have a Hann window \[Welch 1967\]; the median resists a few gross errors.
    pub spectrum: Vec<(f64, f64)>,
    /// Error by confidence, ten bins from 0 to 1.
    pub by_confidence: Vec<ConfidenceBin>,
    /// Median size of the residual in each camera that has one, sorted.
    pub by_camera: Vec<f64>,
    /// Median size of the residual of each keypoint, all cameras.
    pub by_point: Vec<(Keypoint, f64)>,
}

impl DetectorTracks {
    /// Compares `frames` with a body; `posture` gives the body at a capture time, and frames
    /// without one are skipped. Of several people, the one nearest to the projected body is used.
    pub fn compare<'a>(
        rig: &Rig,
        format: KeypointFormat,
        frames: impl IntoIterator<Item = &'a Detections>,
        body: &Skeleton,
        mut posture: impl FnMut(Timestamp) -> Option<Posture>,
    ) -> Self {
        let points = fitted_points(format);
        let of_camera = |camera| {
            let track = move |p: &BodyPoint| (camera, p.keypoint);
            points.iter().map(track).collect::<Vec<_>>()
        };
        let tracks = (0..rig.cameras.len()).flat_map(of_camera);
        let tracks = tracks
            .map(|(camera, keypoint)| PointTrack { camera, keypoint, samples: Vec::new() })
            .collect();
        let mut all = Self { tracks, ..Self::default() };
        for frame in frames {
            let Some(camera) = rig.cameras.get(frame.camera) else { continue };
            if let Some(posture) = posture(frame.capture) {
                all.add(camera, frame, &points, body, &posture);
            }
        }
        all
    }

    fn add(
        &mut self,
        camera: &Camera,
        frame: &Detections,
        points: &[BodyPoint],
        body: &Skeleton,
        posture: &Posture,
    ) {
        let joints = posture.positions.iter().filter_map(|joint| camera.project(joint));
        let Some(height) = height(joints) else { return };
        let projected: Vec<Option<Vector2<f64>>> = (points.iter())
            .map(|p| camera.project(&p.attachment.position(posture, body)))
            .map(|pixel| pixel.filter(|pixel| in_image(camera, pixel)))
            .collect();
        self.frames += 1;
        self.with_others += usize::from(frame.people.len() > 1);
        let Some(person) = performer(frame, points, &projected, GATE * height) else {
            self.without_performer += 1;
            return;
        };
        let seconds = frame.capture.ns() as f64 * 1e-9;
        let first = frame.camera * points.len();
        for (index, (point, pixel)) in points.iter().zip(&projected).enumerate() {
            let Some(pixel) = pixel else { continue };
            let seen = detected(person, point).map(|detection| Seen {
                residual: (detection.pixel.coords - pixel) / height,
                confidence: detection.confidence,
            });
            self.tracks[first + index].samples.push((seconds, seen));
        }
        self.count_inversions(person, points, &projected, height);
    }

    fn count_inversions(
        &mut self,
        person: &Person,
        points: &[BodyPoint],
        projected: &[Option<Vector2<f64>>],
        height: f64,
    ) {
        let find = |keypoint| {
            let index = points.iter().position(|p| p.keypoint == keypoint)?;
            Some((projected[index]?, detected(person, &points[index])?.pixel.coords))
        };
        for (left, right) in PAIRS {
            let (Some((l, dl)), Some((r, dr))) = (find(left), find(right)) else { continue };
            if (l - r).norm() < 0.08 * height {
                continue;
            }
            self.pairs += 1;
            let (straight, crossed) =
                ((dl - l).norm() + (dr - r).norm(), (dl - r).norm() + (dr - l).norm());
            self.inverted += usize::from(crossed < 0.5 * straight);
        }
    }

    /// The statistics; `None` without detected points. `fps`: frame rate of every camera.
    pub fn statistics(&self, fps: f64) -> Option<DetectorStatistics> {
        let seen: Vec<Seen> = self.tracks.iter().flat_map(|t| t.seen()).collect();
        let sizes: Vec<f64> = seen.iter().map(|s| s.residual.norm()).collect();
        let [residual_median, residual_p95] = percentiles(&sizes, [50.0, 95.0])?;
        let centres: Vec<Vector2<f64>> = self.tracks.iter().map(PointTrack::centre).collect();
        let systematic: Vec<f64> = (self.tracks.iter().zip(&centres))
            .filter(|(track, _)| track.seen().next().is_some())
            .map(|(_, centre)| centre.norm())
            .collect();
        let varying: Vec<f64> = (self.tracks.iter().zip(&centres))
            .flat_map(|(t, centre)| t.seen().map(move |s| (s.residual - centre).norm()))
            .collect();
        let runs: Vec<f64> = self.tracks.iter().flat_map(|t| t.gaps(fps)).collect();
        let samples: usize = self.tracks.iter().map(|t| t.samples.len()).sum();
        let bends: Vec<f64> = self.tracks.iter().flat_map(|t| t.second_differences(fps)).collect();
        let share = |part: usize, of: usize| part as f64 / of.max(1) as f64;
        Some(DetectorStatistics {
            points: seen.len(),
            residual_median,
            residual_p95,
            systematic: median(&systematic).unwrap_or(0.0),
            varying: median(&varying).unwrap_or(0.0),
            second_difference: median(&bends).unwrap_or(0.0),
            missing: share(samples - seen.len(), samples),
            missing_run_s: mean(&runs).unwrap_or(0.0),
            without_performer: share(self.without_performer, self.frames),
            with_others: share(self.with_others, self.frames),
            inverted: share(self.inverted, self.pairs),
            spectrum: self.spectrum(fps),
            by_confidence: by_confidence(&seen),
            by_camera: self.by_camera(),
            by_point: self.by_point(),
        })
    }

    fn spectrum(&self, fps: f64) -> Vec<(f64, f64)> {
        let pieces: Vec<[f64; PIECE / 2]> = self
            .tracks
            .iter()
            .flat_map(|track| track.pieces(fps))
            .map(|p| power(&p, fps))
            .collect();
        if pieces.is_empty() {
            return Vec::new();
        }
        let at = |bin: usize| pieces.iter().map(|p| p[bin]).collect::<Vec<_>>();
        (0..PIECE / 2)
            .map(|bin| ((bin + 1) as f64 * fps / PIECE as f64, median(&at(bin)).unwrap_or(0.0)))
            .collect()
    }

    fn by_camera(&self) -> Vec<f64> {
        let cameras = self.tracks.chunk_by(|a, b| a.camera == b.camera);
        let size = |tracks: &[PointTrack]| {
            let seen = tracks.iter().flat_map(PointTrack::seen);
            median(&seen.map(|seen| seen.residual.norm()).collect::<Vec<_>>())
        };
        let mut sizes: Vec<f64> = cameras.filter_map(size).collect();
        sizes.sort_by(f64::total_cmp);
        sizes
    }

    fn by_point(&self) -> Vec<(Keypoint, f64)> {
        let mut points: Vec<Keypoint> = self.tracks.iter().map(|t| t.keypoint).collect();
        points.sort();
        points.dedup();
        let sizes = |keypoint: Keypoint| -> Vec<f64> {
            let tracks = self.tracks.iter().filter(|t| t.keypoint == keypoint);
            tracks.flat_map(|t| t.seen().map(|s| s.residual.norm())).collect()
        };
        points.into_iter().filter_map(|k| Some((k, median(&sizes(k))?))).collect()
    }
}

impl PointTrack {
    fn seen(&self) -> impl Iterator<Item = Seen> + '_ {
        self.samples.iter().filter_map(|(_, seen)| *seen)
    }

    /// Median residual of each axis.
    fn centre(&self) -> Vector2<f64> {
        let axis = |i: usize| median(&self.seen().map(|s| s.residual[i]).collect::<Vec<_>>());
        Vector2::new(axis(0).unwrap_or(0.0), axis(1).unwrap_or(0.0))
    }

    /// Runs of residuals of consecutive frames, without gaps.
    fn runs(&self, fps: f64) -> Vec<Vec<Vector2<f64>>> {
        let mut runs: Vec<Vec<Vector2<f64>>> = Vec::new();
        let mut last = f64::NEG_INFINITY;
        for &(seconds, seen) in &self.samples {
            let Some(seen) = seen else { continue };
            let follows = seconds - last < GAP_PERIODS / fps;
            match runs.last_mut() {
                Some(run) if follows => run.push(seen.residual),
                _ => runs.push(vec![seen.residual]),
            }
            last = seconds;
        }
        runs
    }

    fn pieces(&self, fps: f64) -> Vec<Vec<Vector2<f64>>> {
        let runs = self.runs(fps);
        let of = |run: &Vec<Vector2<f64>>| {
            run.windows(PIECE).step_by(HOP).map(<[_]>::to_vec).collect::<Vec<_>>()
        };
        runs.iter().flat_map(of).collect()
    }

    fn second_differences(&self, fps: f64) -> Vec<f64> {
        let bend = |w: &[Vector2<f64>]| (w[0] - w[1] * 2.0 + w[2]).norm();
        self.runs(fps).iter().flat_map(|run| run.windows(3).map(bend).collect::<Vec<_>>()).collect()
    }

    /// Lengths of runs of missing frames, seconds.
    fn gaps(&self, fps: f64) -> Vec<f64> {
        let follows = |(a, one): &(f64, Option<_>), (b, next): &(f64, Option<_>)| {
            one.is_none() == next.is_none() && b - a < GAP_PERIODS / fps
        };
        let runs = self.samples.chunk_by(follows).filter(|run| run[0].1.is_none());
        runs.map(|run| run.len() as f64 / fps).collect()
    }
}

/// Limb points whose sides a detector confuses.
const PAIRS: [(Keypoint, Keypoint); 4] = [
    (Keypoint::LElbow, Keypoint::RElbow),
    (Keypoint::LWrist, Keypoint::RWrist),
    (Keypoint::LKnee, Keypoint::RKnee),
    (Keypoint::LAnkle, Keypoint::RAnkle),
];

fn detected(person: &Person, point: &BodyPoint) -> Option<Detection> {
    person.points.get(point.index).copied().flatten()
}

fn in_image(camera: &Camera, pixel: &Vector2<f64>) -> bool {
    let (width, height) = (f64::from(camera.width), f64::from(camera.height));
    (-0.5..width - 0.5).contains(&pixel.x) && (-0.5..height - 0.5).contains(&pixel.y)
}

/// The larger side of the box around the pixels.
fn height(pixels: impl Iterator<Item = Vector2<f64>>) -> Option<f64> {
    let bounds = pixels.map(|p| (p, p)).reduce(|a, b| (a.0.inf(&b.0), a.1.sup(&b.1)));
    bounds.map(|(low, high)| (high - low).max()).filter(|&height| height > 1.0)
}

/// The person nearest to the projected body, if one is near.
fn performer<'a>(
    frame: &'a Detections,
    points: &[BodyPoint],
    projected: &[Option<Vector2<f64>>],
    gate: f64,
) -> Option<&'a Person> {
    let distance = |person: &Person| {
        let pairs = points.iter().zip(projected);
        let distances: Vec<f64> = pairs
            .filter_map(|(point, pixel)| {
                Some((detected(person, point)?.pixel.coords - (*pixel)?).norm())
            })
            .collect();
        // A person of few points may be near by chance.
        median(&distances).filter(|_| distances.len() >= points.len() / 3)
    };
    let near = frame.people.iter().filter_map(|person| Some((distance(person)?, person)));
    let nearest = near.min_by(|a, b| a.0.total_cmp(&b.0))?;
    (nearest.0 <= gate).then_some(nearest.1)
}

/// Power of a segment, share^2 per hertz, at 1 to 16 times fps / 32.
fn power(piece: &[Vector2<f64>], fps: f64) -> [f64; PIECE / 2] {
    let mean = piece.iter().sum::<Vector2<f64>>() / PIECE as f64;
    let phase = |i: usize| std::f64::consts::TAU * i as f64 / PIECE as f64;
    let hann = |i: usize| 0.5 - 0.5 * phase(i).cos();
    let norm = fps * (0..PIECE).map(|i| hann(i) * hann(i)).sum::<f64>();
    std::array::from_fn(|bin| {
        let (mut re, mut im) = (Vector2::zeros(), Vector2::zeros());
        for (i, value) in piece.iter().enumerate() {
            let (sin, cos) = (phase(i) * (bin + 1) as f64).sin_cos();
            re += (value - mean) * (hann(i) * cos);
            im += (value - mean) * (hann(i) * sin);
        }
        let sides = if bin + 1 == PIECE / 2 { 1.0 } else { 2.0 };
        sides * (re.norm_squared() + im.norm_squared()) / norm
    })
}

fn by_confidence(seen: &[Seen]) -> Vec<ConfidenceBin> {
    let bin_of = |confidence: f64| ((confidence * BINS as f64) as usize).min(BINS - 1);
    (0..BINS)
        .map(|bin| {
            let of_bin = seen.iter().filter(|s| bin_of(s.confidence) == bin);
            let errors: Vec<f64> = of_bin.map(|s| s.residual.norm()).collect();
            ConfidenceBin {
                range: [bin, bin + 1].map(|edge| edge as f64 / BINS as f64),
                share: errors.len() as f64 / seen.len().max(1) as f64,
                median_error: median(&errors).unwrap_or(0.0),
                mean_error: mean(&errors).unwrap_or(0.0),
            }
        })
        .collect()
}
