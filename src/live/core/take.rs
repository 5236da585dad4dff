//! Slates: a take begins or ends, a body is forgotten, a performer is labelled, named, followed or dropped, or a
//! camera is mended, judged, or its capture times are corrected.
//!
//! A take is a run of its own: at its start the node begins anew with the calibration, the body, the
//! latency and the time offsets that are known, and the head of the take's journal holds them. So a
//! replay of the take needs nothing of the time before.

use super::Core;
use super::port::{Carried, Output, Settings, as_replayed};
use super::publication::Content;
use crate::core::stage::{PerformerId, Stage};
use crate::core::time::Timestamp;
use crate::core::tracker::EventKind;
use crate::io::wire::{self, PerformerLabel, Take, TakeAnswer, encode, valid_name};
use crate::metrics::CameraState;

/// Longer verdicts are cut, characters.
const MOST_WORDS: usize = 500;

/// Whether a slate ends the run of the take `running`, or of none if that is empty.
pub(crate) fn ends(slate: &Take, running: &str) -> bool {
    match slate.action.as_str() {
        "start" => valid_name(&slate.name).is_ok(),
        "stop" => !running.is_empty() && (slate.name.is_empty() || slate.name == running),
        _ => false,
    }
}

impl Core {
    /// Handles a slate.
    pub(super) fn slate(&mut self, payload: &[u8]) {
        let take = match wire::decode::<Take>(payload) {
            Ok(take) => take,
            Err(error) => return self.event(EventKind::Unusable, None, error.to_string()),
        };
        // That is for recorders.
        if take.action == "note" {
            return;
        }
        if take.action == "start" && valid_name(&take.name).is_ok() {
            let why = format!("take {} begins instead", take.name);
            if let Some(before) = self.starting.replace(take) {
                self.answer(before.id, Err(why));
            }
            return;
        }
        if take.action == "stop"
            && let Some(waiting) =
                self.starting.take_if(|one| take.name.is_empty() || take.name == one.name)
        {
            let text = format!("take {} ended before it began", waiting.name);
            self.answer(waiting.id, Err(text.clone()));
            self.use_held();
            if !ends(&take, &self.running) {
                return self.answer(take.id, Ok(text));
            }
        }
        // The front answers for solvers.
        match &*take.action {
            "verdict" => return self.judge(&take),
            // A solver that came during the take has none to stop.
            "stop" if self.is_solver() && self.running.is_empty() => return,
            "start" | "stop" => {}
            "reset" | "label" | "lock" | "unlock" | "join" if self.is_solver() => {
                let _ = self.follow(&take);
                return;
            }
            _ if self.is_solver() => return,
            _ => {}
        }
        let done = self.follow(&take);
        if let Ok(text) = &done {
            self.event(EventKind::Take, None, text.clone());
        }
        self.answer(take.id, done);
    }

    /// Does the action of a slate, all but `start`. Returns the answer.
    fn follow(&mut self, take: &Take) -> Result<String, String> {
        let is_other = !take.name.is_empty() && take.name != self.running;
        match take.action.as_str() {
            "stop" if self.running.is_empty() => Err("no take runs".to_owned()),
            "stop" if is_other => Err(format!("take {} does not run", take.name)),
            "stop" => {
                self.is_flushed = true;
                self.put_out_bodies();
                Ok(format!("take {} ended", std::mem::take(&mut self.running)))
            }
            "join" => self.join(&take.name),
            "reset" if take.name.is_empty() => self.forget_bodies(),
            "reset" => self.forget_body(&take.name),
            "name" => self.rename(take),
            "follow" => self.follow_at(&take.place_m),
            "drop" => self.drop_performer(&take.name),
            "label" => self.label(take),
            "lock" => self.lock(&take.name, true),
            "unlock" => self.lock(&take.name, false),
            "mend" => self.mend(&take.name),
            "clock" => self.correct_times(&take.name, take.offset_ms),
            "start" => Err(format!("{:?} cannot be the name of a take", take.name)),
            other => Err(format!("{other:?} is no action")),
        }
    }

    /// Keeps what a check finds wrong with a camera, or with all, for the status.
    fn judge(&mut self, Take { name, note, .. }: &Take) {
        let words: String = note.chars().take(MOST_WORDS).collect();
        match self.cameras.iter_mut().find(|camera| camera.name() == name) {
            Some(camera) => camera.set_verdict(&words),
            None if name.is_empty() => self.verdict = words,
            None => {}
        }
    }

    /// The node was started during a take: it takes part.
    fn join(&mut self, name: &str) -> Result<String, String> {
        valid_name(name).map_err(|error| error.to_string())?;
        if !self.running.is_empty() {
            return Err(format!("take {} runs", self.running));
        }
        name.clone_into(&mut self.running);
        Ok(format!("take {name} runs already; this node takes part"))
    }

    /// Forgets the bodies of all performers who are not locked.
    fn forget_bodies(&mut self) -> Result<String, String> {
        let labels = &self.settings.carried.labels;
        let keep: Vec<usize> = (0..labels.len()).filter(|number| labels[*number].locked).collect();
        let names: Vec<String> = keep.iter().map(|number| self.name_of(*number)).collect();
        let names = names.join(", ");
        if !keep.is_empty() && keep.len() == self.known_count() {
            return Err(format!("all performers are locked ({names}): unlock one, then reset"));
        }
        self.forget(|performer| !keep.contains(&performer.0));
        let but = if names.is_empty() { String::new() } else { format!("; locked: {names}") };
        Ok(format!("the body is forgotten and estimated anew{but}"))
    }

    /// Forgets the body of one performer.
    fn forget_body(&mut self, name: &str) -> Result<String, String> {
        let number = self.number_of(name)?;
        if self.label_of(number).is_some_and(|label| label.locked) {
            return Err(format!("{name} is locked: unlock it, then reset"));
        }
        self.forget(|performer| performer.0 == number);
        Ok(format!("the body of {name} is forgotten and estimated anew"))
    }

    fn forget(&mut self, is_forgotten: impl Fn(PerformerId) -> bool) {
        self.sharing.forget(&is_forgotten);
        if let Some(stage) = &mut self.stage {
            stage.forget(is_forgotten);
        }
    }

    /// The stage of several performers.
    fn stage_of_several(&mut self, action: &str) -> Result<&mut Stage, String> {
        if !self.is_several() {
            return Err(format!("{action} needs several performers: set [stage] performers"));
        }
        self.stage.as_mut().ok_or_else(|| "no calibration yet".to_owned())
    }

    /// Gives another name to a performer.
    fn rename(&mut self, take: &Take) -> Result<String, String> {
        let Take { name, new_name, .. } = take;
        let number = self.number_of(name)?;
        valid_name(new_name).map_err(|error| error.to_string())?;
        if *new_name == self.topics.actor || self.settings.carried.solvers.contains(new_name) {
            return Err(format!("{new_name} is the name of a node; choose another one"));
        }
        let is_here = self.followed().into_iter().any(|one| self.name_of(one.0) == *new_name);
        if new_name != name && is_here {
            return Err(format!(
                "another performer here is called {new_name}; rename that one first"
            ));
        }
        let stage = self.stage_of_several("name")?;
        let before = stage.give_name(PerformerId(number), new_name);
        let before = before.map_err(|error| error.to_string())?;
        before.into_iter().chain([PerformerId(number)]).for_each(|one| self.use_name(one));
        self.is_changed = true;
        if new_name != name && !self.bodies_folder().is_empty() {
            let performer = PerformerId(number);
            self.outputs.push_back(Output::Body { performer, name: name.clone(), body: None });
        }
        self.put_out_bodies();
        Ok(format!("{name} is {new_name} from now on"))
    }

    /// The person at a place becomes a performer.
    fn follow_at(&mut self, place: &[f64]) -> Result<String, String> {
        let stage = self.stage_of_several("follow")?;
        let place = <[f64; 2]>::try_from(place).ok().filter(|at| at.iter().all(|c| c.is_finite()));
        let place = place.ok_or("follow needs a place: x and z, metres")?;
        stage.follow_at(place).map_err(|error| error.to_string())?;
        Ok(format!("the person at {:.2}, {:.2} m becomes a performer", place[0], place[1]))
    }

    /// A performer is one no more.
    fn drop_performer(&mut self, name: &str) -> Result<String, String> {
        let performer = PerformerId(self.number_of(name)?);
        if !self.stage_of_several("drop")?.drop_performer(performer) {
            return Err(format!("{name} is not here"));
        }
        Ok(format!("{name} is dropped: not solved until somebody follows this person"))
    }

    /// How a performer is shown.
    pub(super) fn label_of(&self, number: usize) -> Option<&PerformerLabel> {
        self.settings.carried.labels.get(number)
    }

    /// Number of performers who are known, in this take or before.
    fn known_count(&self) -> usize {
        let known =
            self.settings.carried.performers.iter().map(|known| known.performer.0 + 1).max();
        self.performers.len().max(known.unwrap_or(0)).max(usize::from(!self.is_several()))
    }

    /// The number of the performer with that name in its topics.
    fn number_of(&self, name: &str) -> Result<usize, String> {
        if self.is_solver() {
            return self.sharing.number_of(name).ok_or_else(String::new);
        }
        let names: Vec<String> =
            (0..self.known_count()).map(|number| self.name_of(number)).collect();
        names.iter().position(|one| one == name).ok_or_else(|| match &*names.join(", ") {
            "" => format!("no performer {name:?}: no performer was seen yet"),
            names => format!("no performer {name:?}; known: {names}"),
        })
    }

    /// The label of the performer with that name in its topics.
    fn label_by_name(&mut self, name: &str) -> Result<&mut PerformerLabel, String> {
        Ok(self.label_mut(self.number_of(name)?))
    }

    /// The label of the performer with that number.
    pub(super) fn label_mut(&mut self, number: usize) -> &mut PerformerLabel {
        let labels = &mut self.settings.carried.labels;
        if labels.len() <= number {
            labels.resize_with(number + 1, PerformerLabel::default);
        }
        &mut labels[number]
    }

    /// The labels for the next take. With several performers, only of those whom it knows: another number may
    /// go to somebody else.
    fn labels_of_known(&self) -> Vec<PerformerLabel> {
        let known = self.stage.as_ref().map_or_else(Vec::new, Stage::known);
        let mut labels = self.settings.carried.labels.clone();
        for (number, label) in labels.iter_mut().enumerate().filter(|_| self.is_several()) {
            if !known.iter().any(|known| known.performer.0 == number) {
                *label = PerformerLabel::default();
            }
        }
        labels
    }

    /// Sets the name and the colour of a performer that programs show.
    fn label(&mut self, take: &Take) -> Result<String, String> {
        let Take { name, display_name, colour, .. } = take;
        let label = PerformerLabel {
            display_name: display_name.clone(),
            colour: colour.clone(),
            locked: false,
        };
        label.check()?;
        let before = self.label_by_name(name)?;
        *before = PerformerLabel { locked: before.locked, ..label };
        let shown = if display_name.is_empty() { name } else { display_name };
        let colour = if colour.is_empty() { "the default colour" } else { colour };
        Ok(format!("{name} is shown as {shown:?}, {colour}"))
    }

    fn lock(&mut self, name: &str, locked: bool) -> Result<String, String> {
        self.label_by_name(name)?.locked = locked;
        Ok(match locked {
            true => format!("{name} is locked: a reset keeps the body"),
            false => format!("{name} is unlocked"),
        })
    }

    /// The node ends before the take begins.
    pub(super) fn give_up_start(&mut self) {
        if let Some(take) = self.starting.take() {
            self.answer(take.id, Err("the node ends".to_owned()));
        }
    }

    fn answer(&mut self, id: u64, done: Result<String, String>) {
        let refused = done.is_err();
        let text = done.unwrap_or_else(|why| why);
        let text = format!("{}: {text}", self.topics.actor);
        let answer = TakeAnswer { id, role: "node".into(), text, refused, ..TakeAnswer::default() };
        self.publish(self.topics.take_answers(), Timestamp::default(), Content::Answer(answer));
    }

    /// Ends this run and begins that of the take. No job may be out.
    pub(super) fn begin_take(&mut self, take: Take) {
        let is_unsolved = self.is_front() && self.settings.carried.solvers.is_empty();
        let unsolved = if is_unsolved { "; no solver is there: nobody is solved" } else { "" };
        let text = format!("take {} begins{unsolved}", take.name);
        self.event(EventKind::Take, None, text.clone());
        self.put_out_bodies();
        self.publish_counts();
        self.publish_status();
        self.write_journal(true);
        let stage = self.stage.as_ref();
        let body = |stage: &Stage| stage.lead().known_body().map(|b| wire::Skeleton::from_core(b));
        let is_several = self.is_several();
        let settings = Settings {
            body: match stage {
                Some(_) if is_several => None,
                Some(stage) => body(stage).map(|body| encode(&body)),
                None => self.settings.body.clone(),
            },
            carried: Carried {
                take: take.name,
                latency: self.latency.declared().or(self.settings.carried.latency),
                // In this take, the network may have left less.
                solve: self.latency.solve().unwrap_or_default().max(self.settings.carried.solve),
                time_offsets: stage
                    .map_or_else(Vec::new, |stage| stage.time_corrections().to_vec()),
                performers: stage.map_or_else(
                    || self.settings.carried.performers.clone(),
                    |stage| stage.known().iter().map(as_replayed).collect(),
                ),
                left_out: stage.map_or_else(Vec::new, Stage::left_out),
                labels: self.labels_of_known(),
                usual_px: self.cameras.iter().map(CameraState::usual_px).collect(),
                verdicts: self.cameras.iter().map(|camera| camera.verdict().to_owned()).collect(),
                verdict: self.verdict.clone(),
                solvers: self.settings.carried.solvers.clone(),
                offsets_are_known: match stage {
                    Some(stage) => stage.lead().body_estimate().knows_offsets(),
                    None => self.settings.carried.offsets_are_known,
                },
            },
            ..self.settings.clone()
        };
        let rig = self.rig().map(<[u8]>::to_vec);
        let rig_at_start = rig.clone().or(self.rig_at_start.take());
        self.reset(settings, rig_at_start);
        // Recorders that came later have no calibration yet.
        if let Some(Ok(rig)) = rig.map(|rig| wire::decode::<wire::Rig>(&rig))
            && !self.is_solver()
        {
            self.publish(self.topics.rig(), Timestamp::default(), Content::Rig(rig));
        }
        self.answer(take.id, Ok(text));
    }
}
