//! Names of topics.

/// Where each message goes: the topics of one stage and one actor.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Topics {
    /// The capture volume.
    pub stage: String,
    /// The performer.
    pub actor: String,
}

impl Default for Topics {
    fn default() -> Self {
        Self { stage: "stage".into(), actor: "actor".into() }
    }
}

impl Topics {
    /// Of [`KeypointFrame`](super::KeypointFrame), one per camera.
    pub fn keypoints(&self, camera: &str) -> String {
        format!("mocap/{}/camera/{camera}/keypoints", self.stage)
    }

    /// Of [`Rig`](super::Rig).
    pub fn rig(&self) -> String {
        format!("mocap/{}/rig", self.stage)
    }

    /// Of [`Pose`](super::Pose).
    pub fn pose(&self) -> String {
        format!("mocap/{}/actor/{}/pose", self.stage, self.actor)
    }

    /// Of provisional [`Pose`](super::Pose)s, of the open window.
    pub fn provisional(&self) -> String {
        format!("mocap/{}/actor/{}/pose/provisional", self.stage, self.actor)
    }

    /// Of [`RetargetedPose`](super::RetargetedPose), on the skeleton of that name.
    pub fn retargeted(&self, name: &str) -> String {
        format!("mocap/{}/actor/{}/retargeted/{name}", self.stage, self.actor)
    }

    /// Of [`Journal`](super::Journal).
    pub fn journal(&self) -> String {
        format!("mocap/{}/actor/{}/journal", self.stage, self.actor)
    }

    /// All that a node publishes of its own.
    pub fn outputs(&self) -> [String; 7] {
        [
            self.pose(),
            self.provisional(),
            self.keyframe(),
            self.skeleton(),
            self.events(),
            self.status(),
            self.journal(),
        ]
    }

    /// Everything of the stage, as a pattern.
    pub fn all(&self) -> String {
        format!("mocap/{}/**", self.stage)
    }

    /// Of [`Keyframe`](super::Keyframe).
    pub fn keyframe(&self) -> String {
        format!("mocap/{}/actor/{}/keyframe", self.stage, self.actor)
    }

    /// Of [`Skeleton`](super::Skeleton).
    pub fn skeleton(&self) -> String {
        format!("mocap/{}/skeleton", self.stage)
    }

    /// Of [`Event`](super::Event).
    pub fn events(&self) -> String {
        format!("mocap/{}/events", self.stage)
    }

    /// Of [`Status`](super::Status).
    pub fn status(&self) -> String {
        format!("mocap/{}/status", self.stage)
    }

    /// Of the true [`Pose`](super::Pose) in a synthetic recording.
    pub fn truth(&self) -> String {
        format!("mocap/{}/actor/{}/truth", self.stage, self.actor)
    }

    /// Of the true [`Skeleton`](super::Skeleton) in a synthetic recording.
    pub fn truth_skeleton(&self) -> String {
        format!("mocap/{}/truth/skeleton", self.stage)
    }
}

/// Whether a topic carries truth: its last or last but one part is `truth`.
pub fn is_truth(topic: &str) -> bool {
    topic.rsplit('/').take(2).any(|part| part == "truth")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_two_topics_of_truth_are_truth() {
        let topics = Topics::default();
        assert!(is_truth(&topics.truth()) && is_truth(&topics.truth_skeleton()));
        let others = [topics.pose(), topics.skeleton(), topics.keypoints("a"), topics.rig()];
        assert!(!others.iter().any(|topic| is_truth(topic)));
        assert_eq!(topics.pose(), "mocap/stage/actor/actor/pose");
    }
}
