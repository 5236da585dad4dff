//! Whose each detection is, with several people in view.
//!
//! At one time, the detections of all views go to the known performers by what each is expected to
//! look like in each view; see [`Expectation`]. What is left over may be new performers; see
//! [`Newcomer`]. The rest is nobody's.
//!
//! - Known performers: in each view the assignment with the least cost in sum, where a detection's
//!   cost is its mean distance from the expected points as a fraction of the performer's size in the
//!   image. Then each performer is moved to where most of the views see it, and the assignment is
//!   repeated with a gate that fits the agreement of the views: a view that contradicts the others
//!   loses its detection. The trunk decides; arms, legs and hips that a detector gave to somebody else
//!   are moved after that, part by part.
//! - Newcomers: pairs of detections in two views whose rays meet in a body with human lengths. Pairs
//!   that most other views agree with come first; each grows over all views and is triangulated
//!   robustly.
//!
//! The work is bounded: see the limits in `newcomers`. The same arguments give the same result.

mod consensus;
mod known;
mod matching;
mod newcomers;
mod pairs;
mod parts;

use std::collections::BTreeSet;

use nalgebra::Vector2;

pub(crate) use matching::{Edge, matching};
pub use newcomers::Newcomer;
pub use parts::{KEYPOINTS, Part, Pixels, Points, pixels_of, points_of};

use crate::core::camera::{Camera, Rig};
use crate::core::detections::{Detections, Person};
use parts::Bounds;

/// Gates of the association. Lengths in the image are fractions of a person's size there.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gates {
    /// A detection this far from the expected points on average is not the performer's.
    pub follow: f64,
    /// A detection this far from a triangulated body on average is not the same person's.
    pub agree: f64,
    /// Points below this confidence are not used.
    pub min_confidence: f64,
}

impl Default for Gates {
    fn default() -> Self {
        Self { follow: 0.20, agree: 0.06, min_confidence: 0.1 }
    }
}

/// What a known performer is expected to look like.
#[derive(Clone, Debug, PartialEq)]
pub struct Expectation {
    /// The predicted points; [`points_of`] gives those of a pose.
    pub points: Points,
    /// By camera of the rig: the last detection that was the performer's. May be shorter.
    pub last: Vec<Option<LastSeen>>,
    /// Whether no view has shown the performer lately. Another one who expects the same detection gets it.
    pub is_hidden: bool,
}

/// A performer in one view, some time ago.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LastSeen {
    /// Expected where the performer has no predicted point.
    pub pixels: Pixels,
    /// The detector's own id; a hint, since detectors lose and exchange ids.
    pub id: Option<i64>,
}

impl LastSeen {
    /// A performer's detection, as [`Assigned::person`] gives it.
    pub fn of(frame: &Detections, person: &Person, min_confidence: f64) -> Self {
        Self { pixels: pixels_of(frame, person, min_confidence), id: person.id }
    }
}

/// A performer's detections in one frame: an index in its people for each part of the body.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Assigned {
    /// By `Part as usize`.
    pub parts: [Option<usize>; Part::ALL.len()],
}

impl Assigned {
    /// All parts of one detection.
    pub fn whole(person: usize) -> Self {
        Self { parts: [Some(person); Part::ALL.len()] }
    }

    /// Whether the performer has a detection of its own in the frame, and not only parts of somebody else's. The head is
    /// never exchanged.
    pub fn is_owned(&self) -> bool {
        self.parts[Part::Upper as usize].is_some()
    }

    /// The performer's points in the frame, together. `None` if it was not seen.
    pub fn person(&self, frame: &Detections) -> Option<Person> {
        let of = |part: Part| frame.people.get(self.parts[part as usize]?);
        let first = Part::ALL.into_iter().find_map(of)?;
        let point = |index: usize| {
            let keypoint = frame.format.keypoints().get(index);
            // Points that are not used go with the head.
            let part = keypoint.map_or(Part::Upper, |keypoint| Part::of(*keypoint));
            *of(part)?.points.get(index)?
        };
        Some(Person { id: first.id, points: (0..frame.format.len()).map(point).collect() })
    }
}

/// Whose the detections are.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Association {
    /// By performer, then by frame.
    pub performers: Vec<Vec<Assigned>>,
    /// The best supported first.
    pub newcomers: Vec<Newcomer>,
    /// By frame: the indices of people of whom no part is anybody's.
    pub nobody: Vec<Vec<usize>>,
}

/// One detection.
#[derive(Clone, Debug)]
struct Sight {
    pixels: Pixels,
    bounds: Bounds,
    /// Index in the frame's people.
    person: usize,
    id: Option<i64>,
}

/// The detections of one camera.
#[derive(Clone, Debug)]
struct View<'a> {
    camera: &'a Camera,
    /// Index of the camera in the rig.
    index: usize,
    /// Index in the frames.
    frame: usize,
    sights: Vec<Sight>,
}

impl View<'_> {
    fn project(&self, points: &Points) -> Pixels {
        points.map(|point| self.camera.project(&point?))
    }
}

/// Finds the performers and newcomers in the frames of one time, at most one of each camera. Frames of
/// cameras that are not in the rig, and second ones of a camera, are nobody's.
pub fn associate(
    rig: &Rig,
    frames: &[&Detections],
    performers: &[Expectation],
    gates: &Gates,
) -> Association {
    let views = views(rig, frames, gates);
    let (known, places) = known::assign(&views, performers, gates);
    let mut free: Vec<Vec<bool>> = views.iter().map(|view| vec![true; view.sights.len()]).collect();
    for (of_views, place) in known.iter().zip(&places) {
        for ((view, assigned), free) in views.iter().zip(of_views).zip(&mut free) {
            assigned.parts.iter().flatten().for_each(|&sight| free[sight] = false);
            known::exclude_copies(view, place, free);
        }
    }
    let newcomers = newcomers::find(&views, free, &places, gates);
    result(frames, &views, known, newcomers)
}

fn views<'a>(rig: &'a Rig, frames: &[&Detections], gates: &Gates) -> Vec<View<'a>> {
    let mut seen = BTreeSet::new();
    let view = |(at, frame): (usize, &&Detections)| {
        let camera = rig.cameras.get(frame.camera).filter(|_| seen.insert(frame.camera))?;
        let sight = |(index, person): (usize, &Person)| {
            let mut pixels = pixels_of(frame, person, gates.min_confidence);
            let is_finite = |pixel: &Vector2<f64>| pixel.iter().all(|value| value.is_finite());
            pixels.iter_mut().for_each(|pixel| *pixel = pixel.filter(is_finite));
            Some(Sight { bounds: Bounds::of(&pixels)?, pixels, person: index, id: person.id })
        };
        let sights = frame.people.iter().enumerate().filter_map(sight).collect();
        Some(View { camera, index: frame.camera, frame: at, sights })
    };
    frames.iter().enumerate().filter_map(view).collect()
}

/// Indices of views and sights become those of frames and people.
fn result(
    frames: &[&Detections],
    views: &[View],
    known: Vec<Vec<Assigned>>,
    mut newcomers: Vec<Newcomer>,
) -> Association {
    let mut is_anybodys: Vec<Vec<bool>> =
        frames.iter().map(|frame| vec![false; frame.people.len()]).collect();
    let mut in_frames = |of_views: &[Assigned]| {
        let mut all = vec![Assigned::default(); frames.len()];
        for (view, assigned) in views.iter().zip(of_views) {
            let parts = assigned.parts.map(|sight| Some(view.sights[sight?].person));
            parts.iter().flatten().for_each(|&person| is_anybodys[view.frame][person] = true);
            all[view.frame] = Assigned { parts };
        }
        all
    };
    let performers = known.iter().map(|of_views| in_frames(of_views)).collect();
    newcomers.iter_mut().for_each(|found| found.views = in_frames(&found.views));
    let unused = |is_used: &Vec<bool>| (0..is_used.len()).filter(|&i| !is_used[i]).collect();
    Association { performers, newcomers, nobody: is_anybodys.iter().map(unused).collect() }
}
