//! The procedural motion and the recordings made of it.

use bundlemocap::body::{Attachment, Joint, Pose, Shape, Skeleton};
use bundlemocap::detect::Keypoint;
use bundlemocap::so3;
use bundlemocap::synth::{Motion, MotionStyle};
use nalgebra::Vector3;

const SOLE: [Keypoint; 6] = [
    Keypoint::LBigToe,
    Keypoint::RBigToe,
    Keypoint::LSmallToe,
    Keypoint::RSmallToe,
    Keypoint::LHeel,
    Keypoint::RHeel,
];

fn point(skeleton: &Skeleton, pose: &Pose, keypoint: Keypoint) -> Vector3<f64> {
    let attachment = Attachment::of(keypoint);
    let (posture, j) = (pose.posture(skeleton), attachment.joint.index());
    posture.positions[j] + posture.rotations[j] * attachment.offset(skeleton.shape())
}

fn shapes() -> [Skeleton; 3] {
    [Shape::default(), Shape([1.5; 10]), Shape([-1.0; 10])].map(Skeleton::new)
}

#[test]
fn the_lower_foot_stays_on_the_floor() {
    for skeleton in shapes() {
        let motion = Motion::new(&skeleton, MotionStyle::default());
        let (mut lowest, mut highest) = (f64::MAX, f64::MIN);
        for frame in 0..1600 {
            let pose = motion.pose(f64::from(frame) / 60.0);
            let low = SOLE.map(|k| point(&skeleton, &pose, k).y).into_iter().fold(9.0, f64::min);
            lowest = lowest.min(low);
            highest = highest.max(low);
        }
        println!("floor {lowest:.4} {highest:.4}");
        assert!(lowest > -0.03 && highest < 0.04, "{lowest} {highest}");
    }
}

#[test]
fn the_motion_is_smooth_and_lively() {
    let skeleton = Skeleton::default();
    let motion = Motion::new(&skeleton, MotionStyle::default());
    let at = |frame: i32| motion.pose(f64::from(frame) / 240.0).posture(&skeleton);
    let (mut worst_jerk, mut sum, mut count) = (0.0f64, 0.0, 0.0);
    for frame in 0..(26 * 240) {
        let p = [at(frame), at(frame + 1), at(frame + 2), at(frame + 3)];
        for joint in Joint::ALL {
            let x = |i: usize| p[i].positions[joint.index()];
            let acceleration = (x(0) - x(1) * 2.0 + x(2)).norm() * 240.0 * 240.0;
            let next = (x(1) - x(2) * 2.0 + x(3)) * 240.0 * 240.0;
            let change = (next - (x(0) - x(1) * 2.0 + x(2)) * 240.0 * 240.0).norm();
            if change > worst_jerk {
                println!("t {:.3} {} change {change:.2}", f64::from(frame) / 240.0, joint.name());
            }
            worst_jerk = worst_jerk.max(change);
            sum += acceleration;
            count += 1.0;
        }
    }
    println!("mean acceleration {:.2}", sum / count);
    assert!((0.5..6.0).contains(&(sum / count)));
    // An acceleration that jumps would change by its whole size in one step of 4 ms.
    assert!(worst_jerk < 12.0, "{worst_jerk}");
}

#[test]
fn planted_feet_do_not_slide() {
    let skeleton = Skeleton::default();
    let motion = Motion::new(&skeleton, MotionStyle::default());
    let heel = |t: f64| point(&skeleton, &motion.pose(t), Keypoint::LHeel);
    // Standing, squatting, reaching and waving: both feet are planted.
    for (from, to) in [(-0.3, -0.1), (6.0, 12.9)] {
        assert!((heel(from) - heel(to)).norm() < 0.01);
    }
    let pelvis = |t: f64| motion.pose(t).root_position;
    assert!(pelvis(6.8).y < pelvis(5.7).y - 0.25, "the squat goes down");
    assert!((pelvis(2.0) - pelvis(1.0)).norm() > 0.8, "the walk gets on");
}

#[test]
fn rotations_are_rotations() {
    let motion = Motion::new(&Skeleton::default(), MotionStyle::default());
    for frame in 0..400 {
        let pose = motion.pose(f64::from(frame) / 30.0);
        assert!(so3::is_rotation(&pose.root_rotation, 1e-9));
        assert!(pose.local.iter().all(|r| so3::is_rotation(r, 1e-9)));
    }
}
