//! Draws the cameras of a rig from above and from the side, as SVG.

use std::fmt::Write as _;

use nalgebra::{Vector2, Vector3};

use super::plot::{PALETTE, escape};
use crate::core::body::{Joint, Posture};
use crate::core::camera::{Camera, Rig};

/// Width of the drawing inside its margins, SVG units.
const WIDTH: f64 = 640.0;
const MARGIN: f64 = 40.0;
/// Depth of a drawn view pyramid, as a share of the rig's extent.
const PYRAMID: f64 = 0.12;
/// Least extent of the drawing, metres.
const MIN_EXTENT: f64 = 1.0;

/// The person drawn in a rig: a posture, and the pelvis's way over the floor.
pub struct Drawn {
    /// The name.
    pub name: String,
    /// A posture of the take.
    pub posture: Posture,
    /// The pelvis over time, world, metres.
    pub path: Vec<Vector3<f64>>,
}

/// How a world point is drawn: metres to the right and upwards.
type Projection = fn(&Vector3<f64>) -> Vector2<f64>;

/// A whole SVG file: the rig from above (x to the right, z down) and from the side (x to the right, y up), with
/// a grid of metres, in one scale.
pub fn draw_rig(rig: &Rig, people: &[Drawn]) -> String {
    let views: [(&str, Projection); 2] = [
        ("from above: x to the right, z down", |p| Vector2::new(p.x, -p.z)),
        ("from the side: x to the right, y up", |p| Vector2::new(p.x, p.y)),
    ];
    let mut points: Vec<Vector3<f64>> = rig.cameras.iter().map(Camera::centre_in_world).collect();
    points.extend(people.iter().flat_map(|one| one.posture.positions.iter().chain(&one.path)));
    points.push(Vector3::zeros());
    let span = points.iter().map(|p| p.x).fold((f64::MAX, f64::MIN), extend);
    let size = |axis: usize| {
        let (low, high) = points.iter().map(|p| p[axis]).fold((f64::MAX, f64::MIN), extend);
        high - low
    };
    let extent = size(0).max(size(1)).max(size(2)).max(MIN_EXTENT);
    // Squares of 1, 10, 100 ... metres, at most 50 on a side.
    let square = 10f64.powf((extent / 30.0).log10().ceil().max(0.0));
    let reach = PYRAMID * extent;
    let (low, high) = (span.0 - 2.0 * reach, span.1 + 2.0 * reach);
    let scale = WIDTH / (extent + 4.0 * reach);
    let (mut body, mut top) = (String::new(), MARGIN);
    for (title, project) in views {
        let ys = points.iter().map(|p| project(p).y).fold((f64::MAX, f64::MIN), extend);
        let (bottom, up) = (ys.0 - 2.0 * reach, ys.1 + 2.0 * reach);
        let view = View { project, scale, square, left: low, up, top };
        let _ = writeln!(
            body,
            "<text x=\"{MARGIN}\" y=\"{:.1}\">{title}; squares of {square} m</text>",
            top - 8.0
        );
        view.grid((low, high), (bottom, up), &mut body);
        for person in people.iter().enumerate() {
            view.person(person, &mut body);
        }
        for camera in &rig.cameras {
            view.camera(camera, reach, &mut body);
        }
        top += (up - bottom) * scale + MARGIN;
    }
    let width = (high - low) * scale + 2.0 * MARGIN;
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width:.1} {top:.1}\" \
         font-family=\"system-ui, sans-serif\" font-size=\"13\" fill=\"#333\">\n\
         <rect width=\"{width:.1}\" height=\"{top:.1}\" fill=\"#fff\"/>\n{body}</svg>\n"
    )
}

fn extend((low, high): (f64, f64), value: f64) -> (f64, f64) {
    (low.min(value), high.max(value))
}

/// One view of the rig.
struct View {
    project: Projection,
    /// SVG units per metre.
    scale: f64,
    /// Side of a square of the grid, metres.
    square: f64,
    /// The world's coordinates of its left and upper edges.
    left: f64,
    up: f64,
    /// SVG coordinate of its upper edge.
    top: f64,
}

impl View {
    fn place(&self, at: Vector2<f64>) -> (f64, f64) {
        (MARGIN + (at.x - self.left) * self.scale, self.top + (self.up - at.y) * self.scale)
    }

    /// SVG path through world points.
    fn path(&self, points: impl IntoIterator<Item = Vector3<f64>>) -> String {
        let mut path = String::new();
        for (i, point) in points.into_iter().enumerate() {
            let (x, y) = self.place((self.project)(&point));
            let _ = write!(path, "{}{x:.1} {y:.1}", if i == 0 { 'M' } else { 'L' });
        }
        path
    }

    /// The grid; the axes are darker.
    fn grid(&self, (left, right): (f64, f64), (bottom, up): (f64, f64), svg: &mut String) {
        let mut line = |from: Vector2<f64>, to: Vector2<f64>, is_axis: bool| {
            let ((x1, y1), (x2, y2)) = (self.place(from), self.place(to));
            let colour = if is_axis { "#999" } else { "#e4e6ea" };
            let _ = writeln!(
                svg,
                "<path d=\"M{x1:.1} {y1:.1}L{x2:.1} {y2:.1}\" stroke=\"{colour}\" fill=\"none\"/>"
            );
        };
        let lines = |from: f64, to: f64| {
            let at = |i: i64| (i as f64 * self.square, i == 0);
            ((from / self.square).ceil() as i64..=(to / self.square).floor() as i64).map(at)
        };
        for (x, is_axis) in lines(left, right) {
            line(Vector2::new(x, bottom), Vector2::new(x, up), is_axis);
        }
        for (y, is_axis) in lines(bottom, up) {
            line(Vector2::new(left, y), Vector2::new(right, y), is_axis);
        }
    }

    /// The view pyramid, with the camera's name.
    fn camera(&self, camera: &Camera, reach: f64, svg: &mut String) {
        let centre = camera.centre_in_world();
        let [width, height] = [camera.width, camera.height].map(f64::from);
        let corners = [(0.0, 0.0), (width, 0.0), (width, height), (0.0, height)];
        let corner = |(x, y): (f64, f64)| {
            let ray = Vector3::new(
                (x - camera.centre.x) / camera.focal.x,
                (y - camera.centre.y) / camera.focal.y,
                1.0,
            );
            centre + camera.rotation.transpose() * ray * reach
        };
        let corners = corners.map(corner);
        let edges = corners.iter().map(|corner| self.path([centre, *corner]));
        let path: String = edges.chain([self.path(corners) + "Z"]).collect();
        let _ = writeln!(svg, "<path d=\"{path}\" stroke=\"#333\" fill=\"none\"/>");
        let (x, y) = self.place((self.project)(&centre));
        let _ = writeln!(
            svg,
            "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"3\"/>\
             <text x=\"{:.1}\" y=\"{:.1}\">{}</text>",
            x + 6.0,
            y - 6.0,
            escape(&camera.name)
        );
    }

    fn person(&self, (i, person): (usize, &Drawn), svg: &mut String) {
        let colour = PALETTE[i % PALETTE.len()];
        let path = self.path(person.path.iter().copied());
        let _ = writeln!(
            svg,
            "<path d=\"{path}\" stroke=\"{colour}\" stroke-opacity=\"0.35\" fill=\"none\"/>"
        );
        let at = |joint: Joint| person.posture.positions[joint.index()];
        let bones = Joint::ALL.into_iter().filter_map(|joint| Some((joint, joint.parent()?)));
        let path: String =
            bones.map(|(joint, parent)| self.path([at(parent), at(joint)])).collect();
        let _ = writeln!(
            svg,
            "<path d=\"{path}\" stroke=\"{colour}\" stroke-width=\"3\" stroke-linecap=\"round\" fill=\"none\"/>"
        );
        let (x, y) = self.place((self.project)(&at(Joint::Head)));
        let _ = writeln!(
            svg,
            "<text x=\"{:.1}\" y=\"{:.1}\" fill=\"{colour}\">{}</text>",
            x + 8.0,
            y - 8.0,
            escape(&person.name)
        );
    }
}
