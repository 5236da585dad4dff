//! Live retargeting: poses from the bus, retargeted poses to the bus.

use std::fmt;
use std::time::Duration;

use prost::Name;

use super::clock::{ATTENTION, Stop};
use super::failure::Failure;
use super::retarget_file::TargetFile;
use super::terminal::complain;
use crate::core::body::Skeleton;
use crate::core::time::Timestamp;
use crate::io::bus::{Bus, BusError, Publisher};
use crate::io::wire::{
    self, DecodeError, Pose, RetargetedPose, Schema, Topics, decode, encode, media_type, schema_of,
};
use crate::live::tools::inbox::{Inbox, Received};
use crate::retarget::Retarget;

/// Subscriptions to poses and skeletons, and the publisher of retargeted poses.
pub(super) struct Live {
    skeletons: Inbox,
    poses: Inbox,
    publisher: Box<dyn Publisher>,
}

/// Results of live retargeting.
#[derive(Debug, Default)]
pub(super) struct Served {
    /// The last skeleton.
    pub(super) skeleton: Option<Skeleton>,
    /// Published poses.
    pub(super) published: u64,
    /// Poses that arrived before the first skeleton.
    pub(super) early: u64,
    /// Unusable messages.
    pub(super) unusable: u64,
    /// Poses that the bus refused; they are still kept for the file.
    pub(super) unsent: u64,
    /// Messages that were dropped because the queue was full.
    pub(super) dropped: u64,
}

impl fmt::Display for Served {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { published, early, unusable, unsent, dropped, .. } = self;
        write!(to, "{published} poses retargeted")?;
        let rest = [
            (early, "arrived before the skeleton"),
            (unusable, "unusable messages"),
            (unsent, "could not be published"),
            (dropped, "messages dropped because this computer is too slow"),
        ];
        for (count, what) in rest.iter().filter(|(count, _)| **count > 0) {
            write!(to, ", {count} {what}")?;
        }
        Ok(())
    }
}

impl Live {
    /// Subscribes to skeletons first, so that the skeleton is known when poses arrive.
    pub(super) fn open(bus: &dyn Bus, topics: &Topics, name: &str) -> Result<Self, BusError> {
        Ok(Self {
            publisher: bus.publisher(&topics.retargeted(name))?,
            skeletons: Inbox::open(bus, &topics.skeleton())?,
            poses: Inbox::open(bus, &topics.pose())?,
        })
    }

    /// Retargets poses until a stop request, then the remaining ones.
    pub(super) fn serve(
        mut self,
        retarget: &mut Retarget,
        mut file: Option<&mut TargetFile>,
        stop: &Stop,
    ) -> Result<Served, Failure> {
        let mut served = Served::default();
        loop {
            if stop.is_set() {
                self.skeletons.close();
                self.poses.close();
            }
            let received = self.poses.next(ATTENTION);
            while let Some(received) = self.skeletons.next(Duration::ZERO) {
                let skeleton = wire::<wire::Skeleton>(&received).and_then(|wire| wire.to_core());
                served.skeleton = served.usable(skeleton).or(served.skeleton.take());
            }
            match received {
                Some(received) => {
                    self.put(&received, retarget, file.as_deref_mut(), &mut served)?
                }
                None if stop.is_set() => break,
                None => {}
            }
        }
        served.dropped = self.poses.dropped() + self.skeletons.dropped();
        Ok(served)
    }

    fn put(
        &self,
        received: &Received,
        retarget: &mut Retarget,
        file: Option<&mut TargetFile>,
        served: &mut Served,
    ) -> Result<(), Failure> {
        let pose = wire::<Pose>(received).and_then(|wire| Ok((wire.to_core()?, wire)));
        let Some((stamped, wire)) = served.usable(pose) else { return Ok(()) };
        let Some(skeleton) = &served.skeleton else {
            served.early += 1;
            return Ok(());
        };
        let figure = retarget.apply(&stamped.pose, skeleton)?;
        let message = figure.message(&wire, retarget.target());
        let encoding = media_type(&RetargetedPose::full_name());
        let capture = Timestamp::from_ns(wire.capture_time_ns);
        match self.publisher.put(capture, &encoding, &encode(&message)) {
            Ok(()) => served.published += 1,
            // The pose is still kept for the file.
            Err(error) => {
                if served.unsent == 0 {
                    complain("warning", &format!("cannot publish a pose: {error}"));
                }
                served.unsent += 1;
            }
        }
        if let Some(file) = file {
            file.add(capture, &figure, retarget)?;
        }
        Ok(())
    }
}

impl Served {
    /// The value; errors are counted, and the first one is printed.
    fn usable<T>(&mut self, result: Result<T, DecodeError>) -> Option<T> {
        match result {
            Ok(value) => Some(value),
            Err(error) => {
                if self.unusable == 0 {
                    complain("warning", &format!("unusable message: {error}"));
                }
                self.unusable += 1;
                None
            }
        }
    }
}

/// The message, if it has the schema.
fn wire<T: Schema>(received: &Received) -> Result<T, DecodeError> {
    let sample = &received.sample;
    if schema_of(&sample.topic, &sample.encoding) != Some(T::full_name().as_str()) {
        return Err(DecodeError::Invalid {
            message: T::NAME,
            field: "encoding",
            reason: format!("{:?} on {} is of another schema", sample.encoding, sample.topic),
        });
    }
    decode(&sample.payload)
}

#[cfg(test)]
mod tests {
    use std::path::Path;
    use std::sync::{Arc, Mutex};

    use super::*;
    use crate::core::body::{self, StampedPose, TrackingState};
    use crate::io::bus::{Memory, Sample};
    use crate::io::formats::bvh::Bvh;
    use crate::retarget::{Map, Target};

    fn ours() -> Retarget {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("ours.bvh");
        crate::io::formats::bvh::write_bvh(&path, &Skeleton::default(), 60.0, []).unwrap();
        let bvh = Bvh::parse(&std::fs::read_to_string(path).unwrap()).unwrap();
        let map = Map::default();
        Retarget::new(Target::new(bvh, Path::new("ours.bvh"), &map), &map).unwrap()
    }

    fn pose(x: f64) -> Pose {
        let mut pose = body::Pose::rest();
        pose.root_position.x = x;
        let stamped = StampedPose {
            capture: Timestamp::from_ns((x * 1e9) as i64),
            pose,
            state: TrackingState::Coasting,
            window: 0,
            rig_version: 1,
            provisional: false,
            revision: 0,
        };
        Pose::from_core(&stamped, &Skeleton::default(), None)
    }

    #[test]
    fn poses_go_out_on_the_target_once_the_body_is_known() {
        let (bus, topics, stop) = (Memory::new(), Topics::default(), Stop::default());
        let live = Live::open(&bus, &topics, "robot").unwrap();
        let came: Arc<Mutex<Vec<Sample>>> = Arc::default();
        let sink = Arc::clone(&came);
        let guard = bus.subscribe(
            "mocap/stage/actor/actor/retargeted/robot",
            Box::new(move |sample| sink.lock().unwrap().push(sample)),
        );
        let put = |topic: &str, encoding: &str, payload: &[u8]| {
            let publisher = bus.publisher(topic).unwrap();
            publisher.put(Timestamp::from_ns(70), encoding, payload).unwrap();
        };
        let skeleton = encode(&wire::Skeleton::from_core(&Skeleton::default()));
        put(&topics.skeleton(), "", &skeleton);
        put(&topics.pose(), "", &encode(&pose(1.0)));
        put(&topics.pose(), "application/json", b"{}");
        put(&topics.pose(), "", b"\xff\xff");
        put(&topics.pose(), &media_type("bundlemocap.v1.Pose"), &encode(&pose(2.0)));
        put(&topics.provisional(), "", &encode(&pose(3.0)));
        stop.stop();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("live.bvh");
        let (mut file, mut retarget) = (TargetFile::new(&path, None), ours());
        let served = live.serve(&mut retarget, Some(&mut file), &stop).unwrap();
        assert!(!path.exists());
        assert_eq!(file.finish(&retarget).unwrap().unwrap().frames, 2);
        assert!(std::fs::read_to_string(&path).unwrap().contains("Frame Time: 1.0"));
        assert_eq!((served.published, served.unusable, served.early), (2, 2, 0));
        assert_eq!(served.to_string(), "2 poses retargeted, 2 unusable messages");
        let came = came.lock().unwrap();
        assert_eq!(came.len(), 2);
        assert_eq!(&*came[1].encoding, "application/protobuf;bundlemocap.v1.RetargetedPose");
        assert_eq!(came[1].capture, Timestamp::from_ns(2_000_000_000));
        let wire: RetargetedPose = decode(&came[1].payload).unwrap();
        let wire = wire.validated().unwrap();
        assert_eq!((wire.joint_names.len(), wire.state), (22, pose(2.0).state));
        assert!((wire.hips_position_m[0] - 2.0).abs() < 1e-9);
        drop(guard);
    }

    #[test]
    fn poses_of_an_unknown_body_are_counted() {
        let (bus, topics, stop) = (Memory::new(), Topics::default(), Stop::default());
        let live = Live::open(&bus, &topics, "robot").unwrap();
        let publisher = bus.publisher(&topics.pose()).unwrap();
        publisher.put(Timestamp::from_ns(1), "", &encode(&pose(1.0))).unwrap();
        stop.stop();
        let served = live.serve(&mut ours(), None, &stop).unwrap();
        assert_eq!((served.published, served.early), (0, 1));
    }
}
