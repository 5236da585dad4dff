//! A procedural motion, repeated: steps along a circle, then a squat, a reach and a wave.
//!
//! A pure function of time, twice differentiable. The feet are planned first (planted or swinging),
//! the pelvis follows them, inverse kinematics places the legs, and arms and trunk swing with the
//! stride. Lengths scale with the leg.

use std::f64::consts::PI;

use nalgebra::{Matrix3, Rotation3, Vector3};

use super::curves::{bump, plateau, smoothstep};
use super::leg::{Leg, Side, about_x, set};
use crate::core::body::{BODY_JOINTS, Joint, Pose, Skeleton};

/// Period of the motion, seconds. Each cycle begins where the last one ended.
const CYCLE: f64 = 13.0;
/// Steps per cycle; the first and the last are half steps.
const STEPS: usize = 9;
/// Time at which the first foot lifts, seconds into the cycle.
const FIRST_STEP: f64 = 0.4;

/// How the performer moves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionStyle {
    /// Distance from one foot to the other, in leg lengths.
    pub step_length: f64,
    /// Time from one step to the next, seconds.
    pub step_time: f64,
    /// Radius of the walked circle, metres. Negative turns right.
    pub radius: f64,
    /// Amplitude of the arm swing, radians.
    pub arm_swing: f64,
    /// Factor on the amplitude of squat, reach and wave.
    pub liveliness: f64,
}

impl Default for MotionStyle {
    fn default() -> Self {
        Self { step_length: 0.67, step_time: 0.55, radius: 1.3, arm_swing: 0.42, liveliness: 1.0 }
    }
}

/// A procedural motion of one body, without an end.
#[derive(Clone, Debug)]
pub struct Motion {
    style: MotionStyle,
    leg: Leg,
}

/// Feet and pelvis at one time; metres and radians.
struct Gait {
    /// Distance along the path: left foot, right foot, pelvis.
    along: [f64; 3],
    /// Height of each foot above the floor.
    lift: [f64; 2],
    /// Rotation of each foot, radians: heel off the ground, toes off the ground.
    roll: [[f64; 2]; 2],
    /// Offset of the pelvis to the left.
    sway: f64,
    /// Lead of the left foot over the right, in step lengths, in \[-1, 1\].
    stride: f64,
}

/// Activation of each part of the motion, in \[0, 1\].
struct Acts {
    walk: f64,
    squat: f64,
    reach: f64,
    wave: f64,
    /// Oscillation of the waving forearm, radians.
    wag: f64,
}

impl Motion {
    /// The motion of the given body.
    pub fn new(skeleton: &Skeleton, style: MotionStyle) -> Self {
        Self { style, leg: Leg::of(skeleton) }
    }

    /// The pose `seconds` after the start. At 0 the performer stands.
    pub fn pose(&self, seconds: f64) -> Pose {
        self.pose_at(seconds, seconds)
    }

    /// A walk on the spot towards +z, after `length` metres of steps; `share` is 1 for full steps and 0
    /// for standing.
    pub(super) fn walk(&self, length: f64, seconds: f64, share: f64) -> Pose {
        // The radius of the circle is that of a straight line; two steps from the third on repeat.
        let style = MotionStyle { radius: 1e6, ..self.style };
        let straight = Self { style, leg: self.leg.clone() };
        let steps = length / (self.style.step_length * self.leg.length());
        let time = FIRST_STEP + (2.0 + steps.rem_euclid(2.0)) * self.style.step_time;
        let [standing, walking] = [0.0, time].map(|time| straight.pose_at(time, seconds));
        let turn = |a, b| crate::core::so3::slerp(a, b, share);
        Pose {
            root_rotation: turn(&standing.root_rotation, &walking.root_rotation),
            root_position: standing.root_position.lerp(&walking.root_position, share),
            local: std::array::from_fn(|j| turn(&standing.local[j], &walking.local[j])),
        }
    }

    /// The pose at `time` of the cycle; breath is that of `seconds`.
    fn pose_at(&self, time: f64, seconds: f64) -> Pose {
        let gait = self.gait(time);
        let acts = self.acts(time);
        let mut pose = Pose::rest();
        self.place_pelvis(&gait, &acts, &mut pose);
        for side in [Side::Left, Side::Right] {
            self.place_leg(side, &gait, &mut pose);
        }
        pose_trunk(seconds, &gait, &acts, &mut pose.local);
        self.pose_arms(&gait, &acts, &mut pose.local);
        pose
    }

    fn gait(&self, seconds: f64) -> Gait {
        let cycle = (seconds / CYCLE).floor();
        let t = seconds - cycle * CYCLE;
        let length = self.style.step_length * self.leg.length();
        let start = cycle * length * (STEPS - 1) as f64;
        let mut gait =
            Gait { along: [start; 3], lift: [0.0; 2], roll: [[0.0; 2]; 2], sway: 0.0, stride: 0.0 };
        let period = self.style.step_time;
        for step in 0..STEPS {
            let foot = step % 2;
            let halved = step == 0 || step == STEPS - 1;
            let advance = if halved { length } else { 2.0 * length };
            let x = (t - FIRST_STEP - step as f64 * period) / period;
            let swing = 0.5 + (x - 0.5) / 0.9;
            gait.along[foot] += advance * smoothstep(swing);
            gait.along[2] += 0.5 * advance * smoothstep(0.25 + 0.5 * x);
            gait.lift[foot] += 0.09 * self.leg.length() * bump(swing);
            let size = if halved { 0.5 } else { 1.0 };
            gait.roll[foot][0] += 0.85 * size * bump((x + 0.6) / 1.2);
            gait.roll[foot][1] += 0.32 * size * bump((x - 0.55) / 0.75);
            let towards_stance = if foot == 0 { -1.0 } else { 1.0 };
            gait.sway += towards_stance * 0.03 * bump((x + 0.4) / 1.8);
        }
        gait.stride = (gait.along[0] - gait.along[1]) / length;
        gait
    }

    fn acts(&self, seconds: f64) -> Acts {
        let t = seconds.rem_euclid(CYCLE);
        let wave = plateau(t, 9.6, 12.7, 0.9);
        let steps_end = FIRST_STEP + STEPS as f64 * self.style.step_time;
        Acts {
            walk: plateau(t, FIRST_STEP - 0.4, steps_end + 0.2, 0.7),
            squat: bump((t - 5.8) / 2.0),
            reach: plateau(t, 7.6, 9.9, 0.9),
            wave,
            wag: 0.45 * wave * (2.0 * PI * 1.6 * (t - 9.6)).sin(),
        }
    }

    /// The point `along` the path and `left` of it, metres, and the heading there as an angle about
    /// y, radians.
    fn on_path(&self, along: f64, left: f64) -> (Vector3<f64>, f64) {
        let yaw = along / self.style.radius;
        let radius = self.style.radius - left;
        (Vector3::new(-radius * yaw.cos(), 0.0, radius * yaw.sin()), yaw)
    }

    fn place_pelvis(&self, gait: &Gait, acts: &Acts, pose: &mut Pose) {
        let leg = self.leg.length();
        let (ground, yaw) = self.on_path(gait.along[2], gait.sway + 0.02 * acts.wave);
        let bob = leg * (0.012 * acts.walk + 0.057 * gait.stride * gait.stride);
        let drop = 0.42 * leg * self.style.liveliness * acts.squat;
        let facing = about_y(yaw);
        let back = facing * Vector3::z() * (0.12 * leg * acts.squat - 0.03 * acts.reach);
        pose.root_position =
            ground - back + Vector3::y() * (self.leg.standing_height() - bob - drop);
        let turn = about_y(-0.10 * gait.stride - 0.12 * acts.reach);
        let tilt = about_x(0.05 + 0.35 * acts.squat) * about_z(gait.sway);
        pose.root_rotation = facing * turn * tilt;
    }

    fn place_leg(&self, side: Side, gait: &Gait, pose: &mut Pose) {
        let foot = side.index();
        let apart = 0.088 * side.sign();
        let (ground, yaw) = self.on_path(gait.along[foot], apart);
        let heading = about_y(yaw + 0.08 * side.sign());
        let [heel_off, toes_off] = gait.roll[foot];
        let lifted = ground + Vector3::y() * gait.lift[foot];
        self.leg.reach(side, &lifted, &heading, heel_off, toes_off, pose);
    }

    fn pose_arms(&self, gait: &Gait, acts: &Acts, local: &mut [Matrix3<f64>; BODY_JOINTS]) {
        let lively = self.style.liveliness;
        for side in [Side::Left, Side::Right] {
            let sign = side.sign();
            let ahead = -sign * gait.stride;
            let (reach, wave) = match side {
                Side::Left => (0.0, acts.wave * lively),
                Side::Right => (acts.reach * lively, 0.0),
            };
            let arm = Arm {
                forward: self.style.arm_swing * ahead + 0.05 + 1.3 * acts.squat + 1.9 * reach,
                raised: -1.33 + 1.35 * wave + 0.15 * reach,
                twist: -0.2 - 1.3 * wave,
                flexion: 0.25 + 0.22 * (1.0 + ahead) + 1.0 * wave - 0.25 * reach,
                wag: if wave > 0.0 { acts.wag } else { 0.0 },
            };
            arm.pose(side, local);
        }
    }
}

/// Angles of the left arm, radians; the right arm mirrors them.
struct Arm {
    forward: f64,
    /// Sideways, above the horizontal.
    raised: f64,
    /// About the upper arm.
    twist: f64,
    flexion: f64,
    /// Sideways swing of the forearm.
    wag: f64,
}

impl Arm {
    fn pose(&self, side: Side, local: &mut [Matrix3<f64>; BODY_JOINTS]) {
        let collar = 0.12 * (self.raised + 1.33);
        let shoulder = about_x(-self.forward)
            * about_z(side.sign() * (self.raised - collar))
            * about_x(self.twist);
        let elbow = about_y(-side.sign() * (self.flexion + self.wag));
        set(local, side.of(Joint::LCollar), about_z(side.sign() * collar));
        set(local, side.of(Joint::LShoulder), shoulder);
        set(local, side.of(Joint::LElbow), elbow);
        set(local, side.of(Joint::LWrist), about_z(-0.08 * side.sign()) * about_y(0.3 * self.wag));
    }
}

/// Poses trunk and head: the trunk counter-rotates to the pelvis, leans in a squat and follows a
/// reach; the head stays level and looks at the hand.
fn pose_trunk(seconds: f64, gait: &Gait, acts: &Acts, local: &mut [Matrix3<f64>; BODY_JOINTS]) {
    let breath = 0.012 * (2.0 * PI * 0.27 * seconds).sin();
    let idle = 0.015 * (2.0 * PI * 0.19 * seconds + 1.0).sin();
    let turn = 0.22 * gait.stride + 0.45 * acts.reach + idle;
    let bend = 0.02 + 0.30 * acts.squat + 0.08 * acts.reach + breath;
    let lean = -0.8 * gait.sway + 0.10 * acts.reach - 0.06 * acts.wave;
    let third = about_y(turn / 3.0) * about_x(bend / 3.0) * about_z(lean / 3.0);
    for joint in [Joint::Spine1, Joint::Spine2, Joint::Spine3] {
        set(local, joint, third);
    }
    let look = -0.10 * gait.stride + 0.15 * acts.reach + 0.25 * acts.wave;
    let nod = -0.35 * acts.squat - 0.30 * acts.reach - 0.03;
    let half = about_y(look / 2.0) * about_x(nod / 2.0) * about_z(-lean / 3.0);
    set(local, Joint::Neck, half);
    set(local, Joint::Head, half);
}

/// Sets the local rotation of a joint other than the pelvis.
pub(super) fn about_y(angle: f64) -> Matrix3<f64> {
    Rotation3::from_axis_angle(&Vector3::y_axis(), angle).into_inner()
}

pub(super) fn about_z(angle: f64) -> Matrix3<f64> {
    Rotation3::from_axis_angle(&Vector3::z_axis(), angle).into_inner()
}
