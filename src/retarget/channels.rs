//! Converts a figure to the channel values of a BVH frame.

use nalgebra::Matrix3;

use super::{Figure, Retarget};
use crate::core::so3;
use crate::io::formats::bvh::Channel;

/// Converts figures to channel values, in the order of the file. Angles are continuous from frame
/// to frame.
#[derive(Clone, Debug, Default)]
pub struct Channels {
    last: Vec<[f64; 3]>,
}

impl Channels {
    /// The values of a frame: positions in the file's unit and world, angles in degrees.
    pub fn values(&mut self, retarget: &Retarget, figure: &Figure) -> Vec<f64> {
        let target = retarget.target();
        self.last.resize(target.joints().len(), [0.0; 3]);
        let mut values = Vec::new();
        for (index, joint) in target.joints().iter().enumerate() {
            let outer = if index == 0 { retarget.world().transpose() } else { Matrix3::identity() };
            let local = outer * figure.locals[index];
            let last = &mut self.last[index];
            let axes = axes(&joint.channels);
            *last = angles(axes, &local, *last);
            let mut turned = 0;
            for channel in &joint.channels {
                values.push(match *channel {
                    Channel::Position(axis) if retarget.mover() == Some(index) => {
                        let parent = joint.parent.map(|parent| target.rest(parent)[axis]);
                        let at = retarget.world().transpose() * figure.positions[index];
                        (at[axis] - parent.unwrap_or(0.0)) / target.unit()
                    }
                    Channel::Position(axis) => joint.offset[axis],
                    Channel::Rotation(_) => {
                        turned += 1;
                        last.get(turned - 1).map_or(0.0, |angle| angle.to_degrees())
                    }
                });
            }
        }
        values
    }
}

/// The usable rotation channels of a joint.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Axes {
    Three([usize; 3]),
    /// The third axis has no channel.
    Two([usize; 3]),
    One(usize),
    None,
}

/// The distinct rotation axes of a joint's first channels.
fn axes(channels: &[Channel]) -> Axes {
    let mut axes = channels.iter().filter_map(|channel| match *channel {
        Channel::Rotation(axis) => Some(axis),
        Channel::Position(_) => None,
    });
    match [axes.next(), axes.next(), axes.next()] {
        [Some(a), Some(b), Some(c)] if a != b && b != c && a != c => Axes::Three([a, b, c]),
        [Some(a), Some(b), _] if a != b => Axes::Two([a, b, 3 - a - b]),
        [Some(a), ..] => Axes::One(a),
        [None, ..] => Axes::None,
    }
}

/// The rotation that a joint's channels give for `rotation`: with three channels itself, with two without its third
/// angle.
pub(super) fn reachable(channels: &[Channel], rotation: &Matrix3<f64>) -> Matrix3<f64> {
    let axes = axes(channels);
    if let Axes::Three(_) = axes {
        return *rotation;
    }
    let [a, b, _] = angles(axes, rotation, [0.0; 3]);
    match axes {
        Axes::Two([i, j, _]) => so3::about(i, a) * so3::about(j, b),
        Axes::One(i) => so3::about(i, a),
        _ => Matrix3::identity(),
    }
}

/// The angles of the channels, radians, nearest to the last ones. With two channels, the third
/// angle is dropped; with one channel, the angle is the one nearest to the rotation.
fn angles(axes: Axes, rotation: &Matrix3<f64>, last: [f64; 3]) -> [f64; 3] {
    match axes {
        Axes::Three(order) => so3::angles(rotation, order, last),
        Axes::Two(order) => {
            let [a, b, _] = so3::angles(rotation, order, [0.0; 3]);
            so3::nearest_turns([a, b, 0.0], last)
        }
        Axes::One(i) => {
            let (p, q) = ((i + 1) % 3, (i + 2) % 3);
            let sine = rotation[(q, p)] - rotation[(p, q)];
            let angle = sine.atan2(rotation[(p, p)] + rotation[(q, q)]);
            so3::nearest_turns([angle, 0.0, 0.0], last)
        }
        Axes::None => [0.0; 3],
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use Channel::{Position, Rotation};
    use nalgebra::Vector3;

    #[test]
    fn joints_with_few_channels_get_the_nearest_rotation() {
        let rotation = so3::exp(&Vector3::new(0.9, 0.0, 0.0));
        let hinge = [Position(0), Rotation(0)];
        assert!((reachable(&hinge, &rotation) - rotation).amax() < 1e-12);
        assert_eq!(reachable(&[Rotation(1)], &rotation), Matrix3::identity());
        assert_eq!(reachable(&[], &rotation), Matrix3::identity());
        let two = so3::about(2, 0.4) * so3::about(0, -0.7);
        assert!((reachable(&[Rotation(2), Rotation(0)], &two) - two).amax() < 1e-12);
        let three = so3::exp(&Vector3::new(0.3, -0.8, 0.5));
        assert_eq!(reachable(&[Rotation(2), Rotation(1), Rotation(0)], &three), three);
        // An order with a repeated axis is used up to the repetition.
        assert_eq!(axes(&[Rotation(2), Rotation(0), Rotation(2)]), Axes::Two([2, 0, 1]));
        assert_eq!(axes(&[Rotation(1), Rotation(1)]), Axes::One(1));
    }
}
