//! Live retargeting: poses from the bus, retargeted poses to the bus.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::fmt;
use std::path::PathBuf;
use std::time::Duration;

use prost::Name;

use super::clock::{ATTENTION, Stop};
use super::export::file_start;
use super::failure::Failure;
use super::retarget_file::TargetFile;
use super::terminal::complain;
use crate::cli::tools::inbox::{Inbox, Received, Unusable};
use crate::core::body::Skeleton;
use crate::core::time::Timestamp;
use crate::io::bus::{Bus, BusError, Publisher};
use crate::io::wire::{
    self, DecodeError, Pose, RetargetedPose, Schema, Topic, Topics, decode, encode, media_type,
    schema_of,
};
use crate::retarget::Retarget;

/// Subscriptions to poses and skeletons, and what becomes of them.
pub(super) struct Live<'a> {
    bus: &'a dyn Bus,
    name: &'a str,
    retarget: &'a Retarget,
    out: &'a dyn Fn(&String) -> Option<PathBuf>,
    skeletons: Inbox,
    poses: Inbox,
}

/// One performer on the target skeleton.
pub(super) struct Retargeted {
    pub(super) retarget: Retarget,
    /// The last skeleton.
    pub(super) skeleton: Option<Skeleton>,
    pub(super) file: Option<TargetFile>,
    /// Path of the file.
    path: Option<PathBuf>,
    publisher: Box<dyn Publisher>,
}

/// Results of live retargeting.
#[derive(Default)]
pub(super) struct Served {
    pub(super) performers: BTreeMap<String, Retargeted>,
    /// Capture time of the first pose of all.
    first: Option<Timestamp>,
    /// Published poses.
    pub(super) published: u64,
    /// Poses that arrived before the first skeleton.
    pub(super) early: u64,
    /// Unusable messages.
    pub(super) unusable: Unusable,
    /// Poses that the bus refused; they are still kept for the file.
    pub(super) unsent: u64,
    /// Files that could not be written.
    pub(super) unwritten: u64,
    /// Messages that were dropped because the queue was full.
    pub(super) dropped: u64,
}

impl fmt::Display for Served {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { published, early, unusable, unsent, dropped, .. } = self;
        write!(to, "{published} poses retargeted")?;
        let rest = [
            (early, "arrived before the skeleton"),
            (&unusable.0, "unusable messages"),
            (unsent, "could not be published"),
            (dropped, "messages dropped because this computer is too slow"),
        ];
        for (count, what) in rest.iter().filter(|(count, _)| **count > 0) {
            write!(to, ", {count} {what}")?;
        }
        Ok(())
    }
}

impl<'a> Live<'a> {
    /// Subscribes to skeletons first, so that the skeleton is known when poses arrive. `topics` may be
    /// those of all actors; `out` gives the file of each.
    pub(super) fn open(
        bus: &'a dyn Bus,
        topics: &Topics,
        name: &'a str,
        retarget: &'a Retarget,
        out: &'a dyn Fn(&String) -> Option<PathBuf>,
    ) -> Result<Self, BusError> {
        let [skeletons, poses] =
            [topics.skeleton(), topics.pose()].map(|pattern| Inbox::open(bus, &pattern));
        Ok(Self { bus, name, retarget, out, skeletons: skeletons?, poses: poses? })
    }

    /// Retargets poses until a stop request, then the remaining ones.
    pub(super) fn serve(mut self, stop: &Stop) -> Result<Served, Failure> {
        let mut served = Served::default();
        loop {
            if stop.is_set() {
                self.skeletons.close();
                self.poses.close();
            }
            let received = self.poses.next(ATTENTION);
            while let Some(received) = self.skeletons.next(Duration::ZERO) {
                let skeleton = wire::<wire::Skeleton>(&received).and_then(|wire| wire.to_core());
                if let Some(skeleton) = served.unusable.value(skeleton)
                    && let Some(one) = self.performer(&received, &mut served)?
                {
                    one.skeleton = Some(skeleton);
                }
            }
            match received {
                Some(received) => self.put(&received, &mut served)?,
                None if stop.is_set() => break,
                None => {}
            }
        }
        served.dropped = self.poses.dropped() + self.skeletons.dropped();
        Ok(served)
    }

    /// Whose message that is. `None`: the topic is not of a performer.
    fn performer<'s>(
        &self,
        received: &Received,
        served: &'s mut Served,
    ) -> Result<Option<&'s mut Retargeted>, BusError> {
        let topic = Topic::parse(&received.sample.topic).ok();
        let Some(topics) = topic.and_then(|topic| topic.topics()) else { return Ok(None) };
        Ok(Some(match served.performers.entry(topics.actor.clone()) {
            Entry::Occupied(known) => known.into_mut(),
            Entry::Vacant(new) => new.insert(Retargeted {
                retarget: self.retarget.clone(),
                skeleton: None,
                file: None,
                path: (self.out)(&topics.actor),
                publisher: self.bus.publisher(&topics.retargeted(self.name))?,
            }),
        }))
    }

    fn put(&self, received: &Received, served: &mut Served) -> Result<(), Failure> {
        let pose = wire::<Pose>(received).and_then(|wire| Ok((wire.to_core()?, wire)));
        let Some((stamped, wire)) = served.unusable.value(pose) else { return Ok(()) };
        let capture = stamped.capture;
        let first = *served.first.get_or_insert(capture);
        let Some(one) = self.performer(received, served)? else { return Ok(()) };
        let Retargeted { retarget, skeleton: Some(skeleton), file, path, publisher } = one else {
            served.early += 1;
            return Ok(());
        };
        let figure = retarget.apply(&stamped.pose, skeleton)?;
        let message = figure.message(&wire, retarget.target());
        let encoding = media_type(&RetargetedPose::full_name());
        let failed = path.as_ref().and_then(|path| {
            let new = || TargetFile::new(path, None, file_start(capture, first));
            file.get_or_insert_with(new).add(capture, &figure, retarget).err()
        });
        // The poses still go out, and those of others to their files.
        if let Some(error) = &failed {
            warn_unwritten(error);
            (*path, *file) = (None, None);
        }
        match publisher.put(capture, &encoding, &encode(&message)) {
            Ok(()) => served.published += 1,
            Err(error) => {
                if served.unsent == 0 {
                    complain("warning", &format!("cannot publish a pose: {error}"));
                }
                served.unsent += 1;
            }
        }
        served.unwritten += u64::from(failed.is_some());
        Ok(())
    }
}

/// Warns that the file of a performer is not written.
pub(super) fn warn_unwritten(error: &Failure) {
    complain("warning", &format!("a file is not written: {}", error.line()));
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
        let capture = Timestamp::from_ns((x * 1e9) as i64);
        let stamped = StampedPose::new(capture, pose, TrackingState::Coasting);
        Pose::from_core(&stamped, &Skeleton::default(), None)
    }

    #[test]
    fn poses_go_out_on_the_target_once_the_body_is_known() {
        let (bus, topics, stop) = (Memory::new(), Topics::default(), Stop::default());
        let folder = tempfile::tempdir().unwrap();
        let out = |actor: &String| Some(folder.path().join(actor).with_extension("bvh"));
        let all = Topics { actor: "*".to_owned(), ..topics.clone() };
        let retarget = ours();
        let live = Live::open(&bus, &all, "robot", &retarget, &out).unwrap();
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
        // Another performer, whose body is not known.
        put("mocap/stage/actor/p2/pose", "", &encode(&pose(4.0)));
        stop.stop();
        let mut served = live.serve(&stop).unwrap();
        assert_eq!((served.published, served.unusable.0, served.early), (2, 2, 1));
        let said = "2 poses retargeted, 1 arrived before the skeleton, 2 unusable messages";
        assert_eq!(served.to_string(), said);
        assert_eq!(served.performers.keys().collect::<Vec<_>>(), ["actor", "p2"]);
        let Retargeted { retarget, file, .. } = served.performers.remove("actor").unwrap();
        let path = folder.path().join("actor.bvh");
        assert!(!path.exists());
        assert_eq!(file.unwrap().finish(&retarget).unwrap().unwrap().frames, 2);
        assert!(std::fs::read_to_string(&path).unwrap().contains("Frame Time: 1.0"));
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
        let retarget = ours();
        let live = Live::open(&bus, &topics, "robot", &retarget, &|_| None).unwrap();
        let publisher = bus.publisher(&topics.pose()).unwrap();
        publisher.put(Timestamp::from_ns(1), "", &encode(&pose(1.0))).unwrap();
        stop.stop();
        let served = live.serve(&stop).unwrap();
        assert_eq!((served.published, served.early), (0, 1));
    }
}
