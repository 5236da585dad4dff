//! Draws postures as stick figures, side by side, in one SVG.

use std::fmt::Write as _;

use nalgebra::{Vector2, Vector3};

use super::plot::escape;
use crate::core::body::{Joint, Posture};

/// SVG units per metre.
const METRE: f64 = 120.0;
/// Gap between neighbours and at the edges, metres.
const GAP: f64 = 0.18;
/// Radius of the head's disc, metres; the disc is ahead of and above its joint.
const HEAD_RADIUS: f64 = 0.105;
const HEAD_OFFSET: Vector3<f64> = Vector3::new(0.0, 0.06, 0.02);
/// Length of the drawn hand, divided by the length of the forearm.
const HAND: f64 = 0.3;

/// View of the stick figures.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StickFigures {
    /// Direction of the viewer: rotation about y from the front, radians.
    pub viewer: f64,
    /// Whether the front is each body's own, otherwise it is +z of the world.
    pub turn_with_body: bool,
}

impl Default for StickFigures {
    fn default() -> Self {
        Self { viewer: 0.65, turn_with_body: true }
    }
}

/// Draws the postures on a floor at y = 0, each with a caption below it. Returns a whole SVG file,
/// an empty one without postures. Left limbs are blue, right limbs orange.
pub fn stick_figures<'a>(
    figures: impl IntoIterator<Item = (&'a Posture, &'a str)>,
    how: &StickFigures,
) -> String {
    let (mut body, mut x, mut top) = (String::new(), GAP, 1.0f64);
    for (posture, caption) in figures {
        let figure = Figure::of(posture, how);
        top = top.max(figure.top());
        let (low, high) = figure.span();
        figure.draw(x - low, &mut body);
        let middle = (x + 0.5 * (high - low)) * METRE;
        let _ = writeln!(
            body,
            "<text x=\"{middle:.1}\" y=\"27\" text-anchor=\"middle\">{}</text>",
            escape(caption)
        );
        x += high - low + GAP;
    }
    let (width, up, below) = (x * METRE, (top + 0.08) * METRE, 36.0);
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 {:.1} {width:.1} {:.1}\" \
         font-family=\"system-ui, sans-serif\" font-size=\"13\" fill=\"#555\">\n\
         <rect y=\"{:.1}\" width=\"{width:.1}\" height=\"{:.1}\" fill=\"#fff\"/>\n\
         <path d=\"M0 0H{width:.1}\" stroke=\"#bbb\"/>\n{body}</svg>\n",
        -up,
        up + below,
        -up,
        up + below
    )
}

/// A line or disc of a stick figure. Coordinates are right and up, metres.
struct Stroke {
    from: Vector2<f64>,
    to: Vector2<f64>,
    /// Depth towards the viewer, metres.
    near: f64,
    /// Width of a line or diameter of a disc (`from` = `to`), metres.
    width: f64,
    colour: &'static str,
}

struct Figure {
    strokes: Vec<Stroke>,
}

impl Figure {
    fn of(posture: &Posture, how: &StickFigures) -> Self {
        let front = posture.rotations[0] * Vector3::z();
        let heading = if how.turn_with_body { front.x.atan2(front.z) } else { 0.0 };
        let yaw = heading + how.viewer;
        let right = Vector3::new(yaw.cos(), 0.0, -yaw.sin());
        let towards = Vector3::new(yaw.sin(), 0.0, yaw.cos());
        let flat = |p: &Vector3<f64>| Vector2::new(right.dot(p), p.y);
        let stroke = |from: &Vector3<f64>, to: &Vector3<f64>, width, colour| Stroke {
            from: flat(from),
            to: flat(to),
            near: towards.dot(&(from + to)) / 2.0,
            width,
            colour,
        };
        let at = |joint: Joint| &posture.positions[joint.index()];
        let mut strokes: Vec<Stroke> = (Joint::ALL.into_iter())
            .filter_map(|joint| Some((joint, joint.parent()?)))
            .map(|(joint, parent)| {
                let (width, colour) = pen(joint);
                stroke(at(parent), at(joint), width, colour)
            })
            .collect();
        for (wrist, elbow) in [(Joint::LWrist, Joint::LElbow), (Joint::RWrist, Joint::RElbow)] {
            let hand = posture.rotations[wrist.index()]
                * posture.rotations[elbow.index()].transpose()
                * (at(wrist) - at(elbow))
                * HAND;
            let (width, colour) = pen(wrist);
            strokes.push(stroke(at(wrist), &(at(wrist) + hand), width, colour));
        }
        let head = at(Joint::Head) + posture.rotations[Joint::Head.index()] * HEAD_OFFSET;
        strokes.push(stroke(&head, &head, 2.0 * HEAD_RADIUS, pen(Joint::Head).1));
        strokes.sort_by(|a, b| a.near.total_cmp(&b.near));
        Self { strokes }
    }

    fn top(&self) -> f64 {
        self.strokes.iter().map(|s| s.from.y.max(s.to.y) + s.width / 2.0).fold(0.0, f64::max)
    }

    /// Smallest and largest horizontal coordinate.
    fn span(&self) -> (f64, f64) {
        self.strokes.iter().fold((f64::MAX, f64::MIN), |(low, high), s| {
            let half = s.width / 2.0;
            (low.min(s.from.x.min(s.to.x) - half), high.max(s.from.x.max(s.to.x) + half))
        })
    }

    fn draw(&self, shift: f64, svg: &mut String) {
        let place = |p: &Vector2<f64>| ((p.x + shift) * METRE, -p.y * METRE);
        for stroke in &self.strokes {
            let ((x1, y1), (x2, y2)) = (place(&stroke.from), place(&stroke.to));
            // A pale outline of each line shows which line is in front.
            for (colour, extra, cap) in [("#fff", 4.0, "butt"), (stroke.colour, 0.0, "round")] {
                let _ = writeln!(
                    svg,
                    "<path d=\"M{x1:.1} {y1:.1}L{x2:.1} {y2:.1}\" stroke=\"{colour}\" \
                     stroke-width=\"{:.1}\" stroke-linecap=\"{cap}\"/>",
                    stroke.width * METRE + extra
                );
            }
        }
    }
}

/// Width in metres and colour of the bone that ends in a joint.
fn pen(joint: Joint) -> (f64, &'static str) {
    use Joint as J;
    let width = match joint {
        J::LKnee | J::RKnee => 0.085,
        J::LAnkle | J::RAnkle => 0.07,
        J::Spine1 | J::Spine2 | J::Spine3 | J::Neck => 0.085,
        J::LElbow | J::RElbow => 0.06,
        _ => 0.05,
    };
    let colour = match joint {
        J::LHip | J::LKnee | J::LAnkle | J::LFoot => "#0072b2",
        J::LCollar | J::LShoulder | J::LElbow | J::LWrist => "#0072b2",
        J::RHip | J::RKnee | J::RAnkle | J::RFoot => "#e08a00",
        J::RCollar | J::RShoulder | J::RElbow | J::RWrist => "#e08a00",
        _ => "#4a5560",
    };
    (width, colour)
}
