//! Names of topics; the grammar is defined only here.

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
    /// The text is not one of our topics.
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

    /// Full name of the schema of messages on this topic.
    pub fn schema(&self) -> &'static str {
        match self {
            Self::Stage { channel, .. } => channel.schema(),
            Self::Actor { channel, .. } => channel.schema(),
        }
    }

    /// Number of last messages that late joiners get; `None` for streams, whose messages are useful
    /// only while they are new.
    pub fn history(&self) -> Option<usize> {
        match self {
            Self::Stage { channel, .. } => channel.history(),
            Self::Actor { channel, .. } => channel.history(),
        }
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

/// Declares kinds of topics. First comes the common prefix. Then each kind has a suffix, a message, the number of last
/// messages for late joiners, and a method of [`Topics`]. Topics of the first kind contain a name.
macro_rules! channels {
    ($(#[$about:meta])* $Channel:ident, $of:ident, $begin:literal {
        $(#[$named_doc:meta])* $Named:ident { $name:ident } = $first:literal, $last:literal:
            $NamedMessage:ident, $named_history:expr, $named_method:ident;
        $($(#[$doc:meta])* $Kind:ident = $path:literal: $Message:ident, $history:expr, $method:ident;)+
    }) => {
        $(#[$about])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
        pub enum $Channel<'a> {
            $(
                $(#[$doc])*
                #[doc = concat!("The topics are `", $begin, $path, "`.")]
                $Kind,
            )+
            $(#[$named_doc])*
            #[doc = concat!("The topics are `", $begin, $first, "{", stringify!($name), "}", $last, "`.")]
            $Named {
                /// The name.
                $name: &'a str,
            },
        }

        impl<'a> $Channel<'a> {
            fn parse(text: &'a str) -> Option<Self> {
                match text {
                    $($path => Some(Self::$Kind),)+
                    _ => {
                        let $name = text.strip_prefix($first)?.strip_suffix($last)?;
                        (!$name.contains('/')).then_some(Self::$Named { $name })
                    }
                }
            }

            fn schema(&self) -> &'static str {
                match self {
                    $(Self::$Kind => $Message::FULL_NAME,)+
                    Self::$Named { .. } => $NamedMessage::FULL_NAME,
                }
            }

            fn history(&self) -> Option<usize> {
                match self {
                    $(Self::$Kind => $history,)+
                    Self::$Named { .. } => $named_history,
                }
            }
        }

        impl fmt::Display for $Channel<'_> {
            fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
                match self {
                    $(Self::$Kind => to.write_str($path),)+
                    Self::$Named { $name } => write!(to, "{}{}{}", $first, $name, $last),
                }
            }
        }

        impl Topics {
            $(
                #[doc = concat!("The topic `", $begin, $path, "` of [`", stringify!($Message), "`] messages.\n")]
                $(#[$doc])*
                pub fn $method(&self) -> String {
                    self.$of($Channel::$Kind)
                }
            )+

            #[doc = concat!("The topic `", $begin, $first, "{", stringify!($name), "}", $last, "` of [`", stringify!($NamedMessage), "`] messages.\n")]
            $(#[$named_doc])*
            pub fn $named_method(&self, $name: &str) -> String {
                self.$of($Channel::$Named { $name })
            }
        }
    };
}

channels! {
    /// Kinds of topics that belong to a whole capture volume.
    StageChannel, of_stage, "mocap/{stage}/" {
        /// The 2D keypoints of one camera.
        Keypoints { camera } = "camera/", "/keypoints": KeypointFrame, None, keypoints;
        /// The calibration.
        Rig = "rig": Rig, Some(1), rig;
        /// Events that concern no performer: of cameras, clocks and queues.
        Events = "events": Event, Some(64), stage_events;
        /// Who is there.
        Status = "status": StageStatus, Some(1), stage_status;
        /// Commands to nodes and recorders, such as that a take begins.
        Take = "take": Take, Some(1), take;
        /// Answers to those commands.
        TakeAnswers = "take/answers": TakeAnswer, Some(8), take_answers;
    }
}

channels! {
    /// Kinds of topics that belong to one performer.
    ActorChannel, of_actor, "mocap/{stage}/actor/{actor}/" {
        /// Poses on another skeleton, which has this name.
        Retargeted { name } = "retargeted/", "": RetargetedPose, None, retargeted;
        /// The performer's 2D keypoints in all cameras.
        Keypoints = "keypoints": KeypointSet, None, actor_keypoints;
        /// What another node needs to go on with the performer.
        HandOver = "hand_over": HandOver, Some(1), hand_over;
        /// The body.
        Skeleton = "skeleton": Skeleton, Some(1), skeleton;
        /// Counters of the node.
        Status = "status": Status, Some(1), status;
        /// Events that concern the performer and the windows.
        Events = "events": Event, Some(64), actor_events;
        /// Solved keyframes.
        Keyframe = "keyframe": Keyframe, Some(8), keyframe;
        /// Final poses.
        Pose = "pose": Pose, None, pose;
        /// Poses of the open window.
        Provisional = "pose/provisional": Pose, None, provisional;
        /// Inputs of the node.
        Journal = "journal": Journal, Some(256), journal;
        /// True poses of a synthetic recording.
        Truth = "truth": Pose, None, truth;
        /// The true body of a synthetic recording.
        TruthSkeleton = "truth/skeleton": Skeleton, None, truth_skeleton;
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

    /// The name under which the solver that is called like this actor announces itself to those that share the
    /// performers of the stage.
    pub fn solver(&self) -> String {
        format!("{ROOT}/{}/solver/{}", self.stage, self.actor)
    }

    /// The name under which recorders announce the take that they record.
    pub fn recorded_take(&self, name: &str) -> String {
        format!("{ROOT}/{}/take/recorded/{name}", self.stage)
    }

    /// Topic of each [`Event`] of that kind.
    pub fn events(&self, kind: EventKind) -> String {
        match super::event::concerns_performer(kind) {
            true => self.actor_events(),
            false => self.stage_events(),
        }
    }

    /// The topics of a node that solves one performer: what a replay compares.
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
            of_actor("mocap/s/actor/a/hand_over", ActorChannel::HandOver),
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
