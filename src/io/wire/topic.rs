//! Names of topics; the grammar is defined only here.
//!
//! | topic | message |
//! |---|---|
//! | `mocap/{stage}/rig` | `Rig` |
//! | `mocap/{stage}/events` | `Event` that concerns no performer |
//! | `mocap/{stage}/status` | `StageStatus` |
//! | `mocap/{stage}/camera/{camera}/keypoints` | `KeypointFrame` |
//! | `mocap/{stage}/take` | `Take` |
//! | `mocap/{stage}/take/answers` | `TakeAnswer` |
//! | `mocap/{stage}/actor/{actor}/keypoints` | `KeypointSet` with the performer alone |
//! | `mocap/{stage}/actor/{actor}/hand_over` | `HandOver` |
//! | `mocap/{stage}/actor/{actor}/skeleton` | `Skeleton` |
//! | `mocap/{stage}/actor/{actor}/status` | `Status` |
//! | `mocap/{stage}/actor/{actor}/events` | `Event` that concerns the performer |
//! | `mocap/{stage}/actor/{actor}/keyframe` | `Keyframe` |
//! | `mocap/{stage}/actor/{actor}/pose` | final `Pose` |
//! | `mocap/{stage}/actor/{actor}/pose/provisional` | provisional `Pose` |
//! | `mocap/{stage}/actor/{actor}/journal` | `Journal` |
//! | `mocap/{stage}/actor/{actor}/retargeted/{name}` | `RetargetedPose` |
//! | `mocap/{stage}/actor/{actor}/truth` | true `Pose` of a synthetic recording |
//! | `mocap/{stage}/actor/{actor}/truth/skeleton` | true `Skeleton` of a synthetic recording |

use std::fmt;

use super::{
    Event, HandOver, Journal, Keyframe, KeypointFrame, KeypointSet, Pose, RetargetedPose, Rig,
    Schema, Skeleton, StageStatus, Status, Take, TakeAnswer,
};
use crate::core::tracker::EventKind;

/// The first part of every topic.
const ROOT: &str = "mocap";

/// A topic. `Display` prints it, [`Topic::parse`] reads it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Topic<'a> {
    /// A topic of a capture volume.
    Stage {
        /// Name of the capture volume.
        stage: &'a str,
        /// The kind of topic.
        channel: StageChannel<'a>,
    },
    /// A topic of one performer.
    Actor {
        /// Name of the capture volume.
        stage: &'a str,
        /// Name of the performer.
        actor: &'a str,
        /// The kind of topic.
        channel: ActorChannel<'a>,
    },
}

/// Kinds of topics that belong to a whole capture volume.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum StageChannel<'a> {
    /// The calibration.
    Rig,
    /// Events that concern no performer: of cameras, clocks and queues.
    Events,
    /// Who is there.
    Status,
    /// The 2D keypoints of one camera.
    Keypoints {
        /// Name of the camera.
        camera: &'a str,
    },
    /// Commands to nodes and recorders: a take begins or ends.
    Take,
    /// Answers to those commands.
    TakeAnswers,
}

/// Kinds of topics that belong to one performer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum ActorChannel<'a> {
    /// The performer's 2D keypoints in all cameras.
    Keypoints,
    /// What another node needs to go on with the performer.
    HandOver,
    /// The body.
    Skeleton,
    /// Counters of the node.
    Status,
    /// Events that concern the performer and the windows.
    Events,
    /// Solved keyframes.
    Keyframe,
    /// Final poses.
    Pose,
    /// Poses of the open window.
    Provisional,
    /// Inputs of the node.
    Journal,
    /// Poses on another skeleton.
    Retargeted {
        /// Name of that skeleton.
        name: &'a str,
    },
    /// True poses of a synthetic recording.
    Truth,
    /// The true body of a synthetic recording.
    TruthSkeleton,
}

/// The text is not a topic of ours.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "{text:?} is not a mocap topic; topics are mocap/STAGE/... and mocap/STAGE/actor/ACTOR/..., as \
     schemas/README.md lists them"
)]
pub struct TopicError {
    /// The text.
    pub text: String,
}

impl<'a> Topic<'a> {
    /// Parses a topic. Names may be any text without a slash, but not empty; so `*` is also parsed
    /// as a name. [`valid_name`] checks names that people choose.
    ///
    /// # Errors
    /// The text is not one of the topics listed above.
    pub fn parse(text: &'a str) -> Result<Self, TopicError> {
        Self::of_parts(text).ok_or_else(|| TopicError { text: text.to_owned() })
    }

    fn of_parts(text: &'a str) -> Option<Self> {
        let (stage, rest) = text.strip_prefix(ROOT)?.strip_prefix('/')?.split_once('/')?;
        if rest.split('/').chain([stage]).any(str::is_empty) {
            return None;
        }
        if let Some(rest) = rest.strip_prefix("actor/") {
            let (actor, rest) = rest.split_once('/')?;
            return Some(Self::Actor { stage, actor, channel: ActorChannel::parse(rest)? });
        }
        Some(Self::Stage { stage, channel: StageChannel::parse(rest)? })
    }

    fn facts(&self) -> Facts {
        match self {
            Self::Stage { channel, .. } => channel.facts(),
            Self::Actor { channel, .. } => channel.facts(),
        }
    }

    /// Full name of the schema of messages on this topic.
    pub fn schema(&self) -> &'static str {
        self.facts().schema
    }

    /// Number of last messages that late joiners get; `None` for streams, whose messages are useful
    /// only while they are new.
    pub fn history(&self) -> Option<usize> {
        self.facts().history
    }

    /// Name of the capture volume.
    pub fn stage(&self) -> &'a str {
        match self {
            Self::Stage { stage, .. } | Self::Actor { stage, .. } => stage,
        }
    }

    /// The actor of a topic, as text; the default one of a topic without one, as in older recordings.
    pub fn actor(topic: &str) -> String {
        let topics = Topic::parse(topic).ok().and_then(|topic| topic.topics());
        topics.unwrap_or_default().actor
    }

    /// The topics of the same stage and actor; `None` for a topic of a stage.
    pub fn topics(&self) -> Option<Topics> {
        match self {
            Self::Stage { .. } => None,
            Self::Actor { stage, actor, .. } => {
                Some(Topics { stage: (*stage).to_owned(), actor: (*actor).to_owned() })
            }
        }
    }
}

/// What is the same for all topics of a channel.
struct Facts {
    /// The end of the topic, or its first part if a name follows.
    path: &'static str,
    /// Full name.
    schema: &'static str,
    /// See [`Topic::history`].
    history: Option<usize>,
}

const fn facts(path: &'static str, schema: &'static str, history: Option<usize>) -> Facts {
    Facts { path, schema, history }
}

impl<'a> StageChannel<'a> {
    const WITHOUT_NAME: [Self; 5] =
        [Self::Rig, Self::Events, Self::Status, Self::Take, Self::TakeAnswers];

    fn facts(&self) -> Facts {
        match self {
            Self::Rig => facts("rig", Rig::FULL_NAME, Some(1)),
            Self::Events => facts("events", Event::FULL_NAME, Some(64)),
            Self::Status => facts("status", StageStatus::FULL_NAME, Some(1)),
            Self::Take => facts("take", Take::FULL_NAME, Some(1)),
            Self::TakeAnswers => facts("take/answers", TakeAnswer::FULL_NAME, Some(8)),
            Self::Keypoints { .. } => facts("camera", KeypointFrame::FULL_NAME, None),
        }
    }

    fn parse(text: &'a str) -> Option<Self> {
        Self::WITHOUT_NAME.into_iter().find(|channel| channel.facts().path == text).or_else(|| {
            let (camera, rest) = text.strip_prefix("camera/")?.split_once('/')?;
            (rest == "keypoints").then_some(Self::Keypoints { camera })
        })
    }
}

impl<'a> ActorChannel<'a> {
    const WITHOUT_NAME: [Self; 11] = [
        Self::Keypoints,
        Self::HandOver,
        Self::Skeleton,
        Self::Status,
        Self::Events,
        Self::Keyframe,
        Self::Pose,
        Self::Provisional,
        Self::Journal,
        Self::Truth,
        Self::TruthSkeleton,
    ];

    fn facts(&self) -> Facts {
        match self {
            Self::Keypoints => facts("keypoints", KeypointSet::FULL_NAME, None),
            Self::HandOver => facts("hand_over", HandOver::FULL_NAME, Some(1)),
            Self::Skeleton => facts("skeleton", Skeleton::FULL_NAME, Some(1)),
            Self::Status => facts("status", Status::FULL_NAME, Some(1)),
            Self::Events => facts("events", Event::FULL_NAME, Some(64)),
            Self::Keyframe => facts("keyframe", Keyframe::FULL_NAME, Some(8)),
            Self::Pose => facts("pose", Pose::FULL_NAME, None),
            Self::Provisional => facts("pose/provisional", Pose::FULL_NAME, None),
            Self::Journal => facts("journal", Journal::FULL_NAME, Some(256)),
            Self::Retargeted { .. } => facts("retargeted", RetargetedPose::FULL_NAME, None),
            Self::Truth => facts("truth", Pose::FULL_NAME, None),
            Self::TruthSkeleton => facts("truth/skeleton", Skeleton::FULL_NAME, None),
        }
    }

    fn parse(text: &'a str) -> Option<Self> {
        Self::WITHOUT_NAME.into_iter().find(|channel| channel.facts().path == text).or_else(|| {
            let name = text.strip_prefix("retargeted/")?;
            (!name.contains('/')).then_some(Self::Retargeted { name })
        })
    }
}

impl fmt::Display for Topic<'_> {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Stage { stage, channel } => write!(to, "{ROOT}/{stage}/{channel}"),
            Self::Actor { stage, actor, channel } => {
                write!(to, "{ROOT}/{stage}/actor/{actor}/{channel}")
            }
        }
    }
}

impl fmt::Display for StageChannel<'_> {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Keypoints { camera } => write!(to, "camera/{camera}/keypoints"),
            channel => to.write_str(channel.facts().path),
        }
    }
}

impl fmt::Display for ActorChannel<'_> {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Retargeted { name } => write!(to, "retargeted/{name}"),
            channel => to.write_str(channel.facts().path),
        }
    }
}

/// Why a name cannot be part of a topic.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "{name:?} cannot be a part of a topic; use up to {MOST_NAME} letters, digits, `-`, `_` and `.`"
)]
pub struct NameError {
    /// The name.
    pub name: String,
}

/// Most characters of a name.
const MOST_NAME: usize = 64;

/// Checks a name for a stage, an actor or a skeleton: 1 to 64 ASCII letters, digits, `-`, `_`
/// and `.`.
///
/// # Errors
/// Any other name.
pub fn valid_name(name: &str) -> Result<(), NameError> {
    let is_allowed = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
    if (1..=MOST_NAME).contains(&name.len()) && name.chars().all(is_allowed) {
        return Ok(());
    }
    Err(NameError { name: name.to_owned() })
}

/// The topics of one stage and one actor.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Topics {
    /// Name of the capture volume.
    pub stage: String,
    /// Name of the performer.
    pub actor: String,
}

impl Default for Topics {
    fn default() -> Self {
        Self { stage: "stage".into(), actor: "actor".into() }
    }
}

impl Topics {
    /// The topics of this stage and actor.
    ///
    /// # Errors
    /// A name that [`valid_name`] refuses.
    pub fn new(stage: &str, actor: &str) -> Result<Self, NameError> {
        valid_name(stage)?;
        valid_name(actor)?;
        Ok(Self { stage: stage.to_owned(), actor: actor.to_owned() })
    }

    fn of_stage(&self, channel: StageChannel) -> String {
        Topic::Stage { stage: &self.stage, channel }.to_string()
    }

    fn of_actor(&self, channel: ActorChannel) -> String {
        Topic::Actor { stage: &self.stage, actor: &self.actor, channel }.to_string()
    }

    /// Topic of [`KeypointFrame`], one per camera.
    pub fn keypoints(&self, camera: &str) -> String {
        self.of_stage(StageChannel::Keypoints { camera })
    }

    /// Topic of [`KeypointSet`], with the performer alone.
    pub fn actor_keypoints(&self) -> String {
        self.of_actor(ActorChannel::Keypoints)
    }

    /// Topic of [`HandOver`].
    pub fn hand_over(&self) -> String {
        self.of_actor(ActorChannel::HandOver)
    }

    /// The name under which the solver that is called like this actor announces itself to those that share the
    /// performers of the stage.
    pub fn solver(&self) -> String {
        format!("{ROOT}/{}/solver/{}", self.stage, self.actor)
    }

    /// The name under which recorders announce the take that they record.
    pub fn recorded_take(&self, name: &str) -> String {
        format!("{ROOT}/{}/take/recorded/{name}", self.stage)
    }

    /// Topic of [`Rig`].
    pub fn rig(&self) -> String {
        self.of_stage(StageChannel::Rig)
    }

    /// Topic of [`Take`]: commands to nodes and recorders.
    pub fn take(&self) -> String {
        self.of_stage(StageChannel::Take)
    }

    /// Topic of [`TakeAnswer`].
    pub fn take_answers(&self) -> String {
        self.of_stage(StageChannel::TakeAnswers)
    }

    /// Topic of each [`Event`] that concerns no performer.
    pub fn stage_events(&self) -> String {
        self.of_stage(StageChannel::Events)
    }

    /// Topic of [`StageStatus`]: who is there.
    pub fn stage_status(&self) -> String {
        self.of_stage(StageChannel::Status)
    }

    /// Topic of each [`Event`] that concerns the performer.
    pub fn actor_events(&self) -> String {
        self.of_actor(ActorChannel::Events)
    }

    /// Topic of each [`Event`] of that kind.
    pub fn events(&self, kind: EventKind) -> String {
        match super::event::concerns_performer(kind) {
            true => self.actor_events(),
            false => self.stage_events(),
        }
    }

    /// Topic of final [`Pose`]s.
    pub fn pose(&self) -> String {
        self.of_actor(ActorChannel::Pose)
    }

    /// Topic of provisional [`Pose`]s, of the open window.
    pub fn provisional(&self) -> String {
        self.of_actor(ActorChannel::Provisional)
    }

    /// Topic of [`RetargetedPose`], on the skeleton with that name.
    pub fn retargeted(&self, name: &str) -> String {
        self.of_actor(ActorChannel::Retargeted { name })
    }

    /// Topic of [`Journal`].
    pub fn journal(&self) -> String {
        self.of_actor(ActorChannel::Journal)
    }

    /// Topic of [`Keyframe`].
    pub fn keyframe(&self) -> String {
        self.of_actor(ActorChannel::Keyframe)
    }

    /// Topic of [`Skeleton`].
    pub fn skeleton(&self) -> String {
        self.of_actor(ActorChannel::Skeleton)
    }

    /// Topic of [`Status`].
    pub fn status(&self) -> String {
        self.of_actor(ActorChannel::Status)
    }

    /// Topic of the true [`Pose`] in a synthetic recording.
    pub fn truth(&self) -> String {
        self.of_actor(ActorChannel::Truth)
    }

    /// Topic of the true [`Skeleton`] in a synthetic recording.
    pub fn truth_skeleton(&self) -> String {
        self.of_actor(ActorChannel::TruthSkeleton)
    }

    /// All topics that a node publishes; not the rig, which is also an input.
    pub fn outputs(&self) -> [String; 9] {
        [
            self.pose(),
            self.provisional(),
            self.keyframe(),
            self.skeleton(),
            self.actor_events(),
            self.stage_events(),
            self.stage_status(),
            self.status(),
            self.journal(),
        ]
    }

    /// Pattern for all topics of the stage.
    pub fn all(&self) -> String {
        format!("{ROOT}/{}/**", self.stage)
    }
}

/// Whether a topic holds truth. Older recordings have the true skeleton on
/// `mocap/{stage}/truth/skeleton`, without an actor.
pub fn is_truth(topic: &str) -> bool {
    match Topic::parse(topic) {
        Ok(Topic::Actor { channel, .. }) => {
            matches!(channel, ActorChannel::Truth | ActorChannel::TruthSkeleton)
        }
        Ok(Topic::Stage { .. }) => false,
        Err(_) => topic.ends_with("/truth/skeleton"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every topic, with the expected result of parsing.
    fn all() -> Vec<(&'static str, Topic<'static>)> {
        let of_stage = |text, channel| (text, Topic::Stage { stage: "s", channel });
        let of_actor = |text, channel| (text, Topic::Actor { stage: "s", actor: "a", channel });
        vec![
            of_stage("mocap/s/rig", StageChannel::Rig),
            of_stage("mocap/s/events", StageChannel::Events),
            of_stage("mocap/s/camera/c/keypoints", StageChannel::Keypoints { camera: "c" }),
            of_stage("mocap/s/take", StageChannel::Take),
            of_stage("mocap/s/status", StageChannel::Status),
            of_stage("mocap/s/take/answers", StageChannel::TakeAnswers),
            of_actor("mocap/s/actor/a/keypoints", ActorChannel::Keypoints),
            of_actor("mocap/s/actor/a/skeleton", ActorChannel::Skeleton),
            of_actor("mocap/s/actor/a/status", ActorChannel::Status),
            of_actor("mocap/s/actor/a/events", ActorChannel::Events),
            of_actor("mocap/s/actor/a/keyframe", ActorChannel::Keyframe),
            of_actor("mocap/s/actor/a/pose", ActorChannel::Pose),
            of_actor("mocap/s/actor/a/pose/provisional", ActorChannel::Provisional),
            of_actor("mocap/s/actor/a/journal", ActorChannel::Journal),
            of_actor("mocap/s/actor/a/retargeted/r", ActorChannel::Retargeted { name: "r" }),
            of_actor("mocap/s/actor/a/truth", ActorChannel::Truth),
            of_actor("mocap/s/actor/a/truth/skeleton", ActorChannel::TruthSkeleton),
        ]
    }

    #[test]
    fn every_topic_is_printed_as_it_is_read() {
        for (text, topic) in all() {
            assert_eq!(Topic::parse(text), Ok(topic));
            assert_eq!(topic.to_string(), text);
            assert_eq!(topic.stage(), "s");
        }
        let topics = Topics::new("s", "a").unwrap();
        for text in topics.outputs() {
            assert!(all().iter().any(|(known, _)| *known == text), "{text}");
        }
        let status = topics.status();
        assert_eq!(Topic::parse(&status).unwrap().topics(), Some(topics));
    }

    #[test]
    fn what_is_no_topic_is_refused() {
        for text in [
            "",
            "mocap",
            "mocap/s",
            "mocap//rig",
            "mocap/s/rig/",
            "mocap/s/status/",
            "mocap/s/skeleton",
            "mocap/s/camera/c",
            "mocap/s/camera//keypoints",
            "mocap/s/camera/c/d/keypoints",
            "mocap/s/actor/a",
            "mocap/s/actor/a/",
            "mocap/s/actor//pose",
            "mocap/s/actor/a/retargeted/",
            "mocap/s/actor/a/retargeted/r/t",
            "mocap/s/actor/a/pose/final",
            "mocap/s/actor/a/keypoints/c",
            "other/s/rig",
        ] {
            let error = Topic::parse(text).unwrap_err();
            assert!(error.to_string().contains(&format!("{text:?}")), "{error}");
        }
    }

    #[test]
    fn names_with_slashes_blanks_or_stars_are_refused() {
        for name in ["", "my stage/1", "a b", "a/b", "*", "größe", "a?"] {
            let error = Topics::new(name, "actor").unwrap_err().to_string();
            assert!(error.contains(&format!("{name:?}")) && error.contains("letters"), "{error}");
            assert!(Topics::new("stage", name).is_err());
        }
        assert!(valid_name("stage-1_b.2").is_ok());
    }

    #[test]
    fn only_the_topics_of_truth_are_truth() {
        let truth: Vec<_> = all().into_iter().filter(|(text, _)| is_truth(text)).collect();
        assert_eq!(truth.len(), 2);
        assert!(truth.iter().all(|(text, _)| text.contains("/truth")));
        assert!(is_truth("mocap/stage/truth/skeleton"));
        assert!(!is_truth("mocap/stage/actor/truth/pose") && !is_truth("mocap/truth/rig"));
    }

    #[test]
    fn events_go_to_the_performer_or_to_the_stage() {
        let topics = Topics::default();
        assert_eq!(topics.events(EventKind::Lost), "mocap/stage/actor/actor/events");
        assert_eq!(topics.events(EventKind::Late), "mocap/stage/events");
    }
}
