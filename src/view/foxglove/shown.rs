//! Our types as Foxglove's messages.

use foxglove::messages::line_primitive::Type as LineType;
use foxglove::messages::log;
use foxglove::messages::points_annotation::Type as PointsType;
use foxglove::messages::{
    self, CameraCalibration, Color, Duration, FrameTransform, FrameTransforms, ImageAnnotations,
    LinePrimitive, Log, Point2, Point3, PointsAnnotation, Quaternion, SceneEntity, SceneUpdate,
    SpherePrimitive, TextPrimitive,
};
use nalgebra::{Matrix3, Vector2, Vector3};

use super::Performer;
use crate::core::body::{JOINTS, Joint, Skeleton, StampedPose, TrackingState};
use crate::core::camera::{Camera, Lens, Rig};
use crate::core::so3;
use crate::core::time::Timestamp;
use crate::io::wire::{Event, KeypointFrame};

/// Our frame, and that with z up.
const WORLD: &str = "world";
const ROOT: &str = "root";
/// The thickness of a bone and the size of a head, metres.
const BONE: f64 = 0.035;
const HEAD: f64 = 0.2;
/// Radius of a keypoint, pixels.
const POINT: f64 = 3.0;
/// Length of a camera's edges, and height of its name, metres.
const CAMERA: f64 = 0.4;
const CAMERA_NAME: f64 = 0.1;
/// How long a pose and a camera are shown if no newer one comes.
const POSE_KEPT_NS: u32 = 500_000_000;
const CAMERA_KEPT_S: i32 = 3;
/// The colours of performers \[Okabe 2008\], as on the page; after these paler ones, then darker ones.
const COLOURS: [&str; 7] =
    ["#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#f0e442"];
/// The colour of a pose that is not tracked, and of cameras.
const GREY: &str = "#8a8f98";
/// The colour of keypoints. Detectors do not know the performers.
const MAGENTA: &str = "#ff00ff";

/// Nanoseconds since 1970; 0 before.
pub(super) fn nanoseconds(at: Timestamp) -> u64 {
    u64::try_from(at.ns()).unwrap_or(0)
}

fn stamp(at: Timestamp) -> Option<messages::Timestamp> {
    let (s, ns) = (nanoseconds(at) / 1_000_000_000, nanoseconds(at) % 1_000_000_000);
    // The schema has no later time than 2106.
    Some(messages::Timestamp::new(u32::try_from(s).unwrap_or(u32::MAX), ns as u32))
}

/// A colour such as #0072b2, with opacity `a`; `None`: another text.
fn colour(hex: &str, a: f64) -> Option<Color> {
    let digits = u32::from_str_radix(hex.strip_prefix('#')?, 16).ok()?;
    let [r, g, b] = [16, 8, 0].map(|shift| f64::from(digits >> shift & 0xff) / 255.0);
    Some(Color { r, g, b, a })
}

/// Rounds lengths to 8 µm and quaternions to 1e-5 rad. Files with such numbers are 30 % smaller.
fn rounded(value: f64) -> f64 {
    const STEPS: f64 = 131_072.0;
    (value * STEPS).round() / STEPS
}

fn vector(v: &Vector3<f64>) -> Option<messages::Vector3> {
    let v = v.map(rounded);
    Some(messages::Vector3 { x: v.x, y: v.y, z: v.z })
}

fn quaternion(rotation: &Matrix3<f64>) -> Option<Quaternion> {
    let [x, y, z, w] = so3::xyzw_from_rotation(rotation).map(rounded);
    Some(Quaternion { x, y, z, w })
}

fn placed(position: &Vector3<f64>) -> Option<messages::Pose> {
    let orientation = quaternion(&Matrix3::identity());
    Some(messages::Pose { position: vector(position), orientation })
}

fn point3(p: &Vector3<f64>) -> Point3 {
    let p = p.map(rounded);
    Point3 { x: p.x, y: p.y, z: p.z }
}

/// A text that always faces the viewer.
fn text(at: &Vector3<f64>, height: f64, color: Option<Color>, text: &str) -> TextPrimitive {
    TextPrimitive {
        pose: placed(at),
        billboard: true,
        font_size: height,
        color,
        text: text.into(),
        ..TextPrimitive::default()
    }
}

/// Performers in poses of one time, with their names.
pub(super) fn performers<'a>(
    all: impl Iterator<Item = (&'a String, &'a Performer, &'a StampedPose)>,
) -> SceneUpdate {
    let entities = all.map(|(name, performer, pose)| bones(name, performer, pose)).collect();
    SceneUpdate { entities, ..SceneUpdate::default() }
}

fn bones(
    name: &str,
    Performer { number, body, label }: &Performer,
    StampedPose { capture, pose, state, .. }: &StampedPose,
) -> SceneEntity {
    let at = pose.posture(body).positions;
    let point = |joint: Joint| point3(&at[joint.index()]);
    let both = |joint: Joint| joint.parent().map(|parent| [point(parent), point(joint)]);
    let of_number = || {
        let own = colour(COLOURS[number % COLOURS.len()], 1.0)?;
        let towards = match (number / COLOURS.len()) % 3 {
            0 => return Some(own),
            1 => 1.0,
            _ => 0.0,
        };
        let half = |value: f64| (value + towards) / 2.0;
        Some(Color { r: half(own.r), g: half(own.g), b: half(own.b), a: 1.0 })
    };
    let color = match *state {
        TrackingState::Tracking => colour(&label.colour, 1.0).or_else(of_number),
        _ => colour(GREY, 1.0),
    };
    let head = at[Joint::Head.index()];
    let lines = LinePrimitive {
        r#type: LineType::LineList as i32,
        pose: placed(&Vector3::zeros()),
        thickness: BONE,
        points: Joint::ALL.into_iter().filter_map(both).flatten().collect(),
        color,
        ..LinePrimitive::default()
    };
    let sphere =
        SpherePrimitive { pose: placed(&head), size: vector(&Vector3::repeat(HEAD)), color };
    let title = if label.display_name.is_empty() { name } else { &label.display_name };
    let above = head + Vector3::y() * 1.5 * HEAD;
    SceneEntity {
        timestamp: stamp(*capture),
        frame_id: WORLD.into(),
        id: name.into(),
        lifetime: Some(Duration::new(0, POSE_KEPT_NS)),
        spheres: vec![sphere],
        lines: vec![lines],
        texts: vec![text(&above, 0.5 * HEAD, color, title)],
        ..SceneEntity::default()
    }
}

/// The cameras and what they see, with any lens, and their names.
pub(super) fn cameras(rig: &Rig, at: Timestamp) -> SceneUpdate {
    let one = |camera: &Camera| {
        let (centre, color) = (camera.centre_in_world(), colour(GREY, 1.0));
        let [width, height] = [camera.width, camera.height].map(f64::from);
        // The centre of the first pixel is (0, 0).
        let [right, below] = [width - 0.5, height - 0.5];
        let corners = [[-0.5, -0.5], [right, -0.5], [right, below], [-0.5, below]];
        // Some wide lenses do not reach the corners of the image.
        let ends = corners.map(|[x, y]| Some(centre + CAMERA * camera.ray(&Vector2::new(x, y))?));
        let edges = (0..4).flat_map(|k| {
            let beside = ends[k].zip(ends[(k + 1) % 4]).map(|(a, b)| [a, b]);
            [ends[k].map(|end| [centre, end]), beside].into_iter().flatten()
        });
        let lines = LinePrimitive {
            r#type: LineType::LineList as i32,
            pose: placed(&Vector3::zeros()),
            thickness: 2.0,
            scale_invariant: true,
            points: edges.flatten().map(|p| point3(&p)).collect(),
            color,
            ..LinePrimitive::default()
        };
        let above = centre + Vector3::y() * CAMERA_NAME;
        SceneEntity {
            timestamp: stamp(at),
            frame_id: WORLD.into(),
            id: camera.name.clone(),
            lifetime: Some(Duration::new(CAMERA_KEPT_S, 0)),
            lines: vec![lines],
            texts: vec![text(&above, CAMERA_NAME, color, &camera.name)],
            ..SceneEntity::default()
        }
    };
    SceneUpdate { entities: rig.cameras.iter().map(one).collect(), ..SceneUpdate::default() }
}

fn transform(
    at: Timestamp,
    [parent, child]: [&str; 2],
    rotation: &Matrix3<f64>,
    translation: &Vector3<f64>,
) -> FrameTransform {
    FrameTransform {
        timestamp: stamp(at),
        parent_frame_id: parent.into(),
        child_frame_id: child.into(),
        translation: vector(translation),
        rotation: quaternion(rotation),
    }
}

/// The joints of performers, each in the frame of its parent.
pub(super) fn joints<'a>(
    all: impl Iterator<Item = (&'a String, &'a Performer, &'a StampedPose)>,
) -> FrameTransforms {
    let all = all.flat_map(|(name, one, pose)| joints_of(name, &one.body, pose));
    FrameTransforms { transforms: all.collect() }
}

fn joints_of(
    name: &str,
    body: &Skeleton,
    StampedPose { capture, pose, .. }: &StampedPose,
) -> [FrameTransform; JOINTS] {
    let frame = |joint: Joint| format!("{name}/{}", joint.name());
    let one = |joint: Joint| match joint.parent() {
        None => {
            let frames = [WORLD, &frame(joint)];
            transform(*capture, frames, &pose.root_rotation, &pose.root_position)
        }
        Some(parent) => {
            let (rotation, offset) = (&pose.local[joint.index() - 1], body.offset(joint));
            transform(*capture, [&frame(parent), &frame(joint)], rotation, offset)
        }
    };
    Joint::ALL.map(one)
}

fn frame_of(camera: &Camera) -> String {
    format!("camera/{}", camera.name)
}

/// The world and the cameras in it.
pub(super) fn camera_frames(rig: &Rig, at: Timestamp) -> FrameTransforms {
    let z_up = so3::about(0, std::f64::consts::FRAC_PI_2);
    let world = transform(at, [ROOT, WORLD], &z_up, &Vector3::zeros());
    let one = |camera: &Camera| {
        let world_from_camera = camera.rotation.transpose();
        transform(at, [WORLD, &frame_of(camera)], &world_from_camera, &camera.centre_in_world())
    };
    let cameras = rig.cameras.iter().map(one);
    FrameTransforms { transforms: std::iter::once(world).chain(cameras).collect() }
}

/// The calibration of a camera.
pub(super) fn calibration(camera: &Camera, at: Timestamp) -> CameraCalibration {
    let k = camera.matrix();
    let rows = |columns: usize| {
        let entry = move |k: usize| (k / columns, k % columns);
        (0..3 * columns).map(entry)
    };
    let (model, d) = match camera.lens() {
        Lens::BrownConrady(d) => ("rational_polynomial", d.to_vec()),
        Lens::Fisheye(d) => ("kannala_brandt", d.to_vec()),
    };
    CameraCalibration {
        timestamp: stamp(at),
        frame_id: frame_of(camera),
        width: camera.width,
        height: camera.height,
        distortion_model: model.into(),
        d,
        k: rows(3).map(|at| k[at]).collect(),
        r: rows(3).map(|(row, column)| f64::from(u8::from(row == column))).collect(),
        p: rows(4).map(|(row, column)| if column < 3 { k[(row, column)] } else { 0.0 }).collect(),
    }
}

/// The keypoints of an image, paler with less confidence.
pub(super) fn keypoints(frame: &KeypointFrame) -> ImageAnnotations {
    let at = Timestamp::from_ns(frame.capture_time_ns);
    let points = frame.people.iter().map(|person| {
        let seen = || person.points.chunks_exact(3).filter(|point| point[2] > 0.0);
        PointsAnnotation {
            timestamp: stamp(at),
            r#type: PointsType::Points as i32,
            points: seen().map(|p| Point2 { x: p[0].into(), y: p[1].into() }).collect(),
            outline_colors: seen()
                .filter_map(|point| colour(MAGENTA, f64::from(point[2]).clamp(0.2, 1.0)))
                .collect(),
            thickness: 2.0 * POINT,
            ..PointsAnnotation::default()
        }
    });
    ImageAnnotations { timestamp: stamp(at), points: points.collect(), ..Default::default() }
}

/// An event as a line of a log. `performer`: whose it is; empty: of the stage.
pub(super) fn log_line(performer: &str, event: &Event) -> Log {
    let camera = event.camera.as_deref().unwrap_or_default();
    let kind = event.kind.replace('_', " ");
    let parts = [camera, &kind, &event.detail].into_iter().filter(|part| !part.is_empty());
    let times = if event.count > 1 { format!(" ({} times)", event.count) } else { String::new() };
    let is_fine = crate::live::is_fine(&event.kind, &event.detail);
    let level = if is_fine { log::Level::Info } else { log::Level::Warning };
    Log {
        timestamp: stamp(Timestamp::from_ns(event.capture_time_ns)),
        level: level as i32,
        message: parts.collect::<Vec<_>>().join(": ") + &times,
        name: performer.into(),
        ..Log::default()
    }
}
