//! What the performers are called.

use super::known::Known;
use super::performer_id::PerformerId;

/// The names of the performers: the given ones, or else p1, p2, ... by number.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Names {
    /// By number; empty: none was given.
    given: Vec<String>,
    /// For those who enter, in this order.
    waiting: Vec<String>,
}

/// A name that a performer cannot have: p1, p2, ... are of numbers.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is the name of a number; choose another one")]
pub struct NumberName(String);

impl Names {
    /// No names are given yet; these wait for those who enter, in this order.
    pub fn new(waiting: Vec<String>) -> Self {
        Self { given: Vec::new(), waiting }
    }

    /// The name of a performer.
    pub fn of(&self, performer: PerformerId) -> String {
        self.given(performer).map_or_else(|| performer.to_string(), str::to_owned)
    }

    /// The name that was given to a performer, if one was.
    pub fn given(&self, performer: PerformerId) -> Option<&str> {
        self.given.get(performer.0).map(String::as_str).filter(|name| !name.is_empty())
    }

    /// The performer to whom this name was given, if there is one.
    pub fn owner(&self, name: &str) -> Option<PerformerId> {
        self.given.iter().position(|given| given == name && !name.is_empty()).map(PerformerId)
    }

    /// Gives a name to a performer. Who had it before is called by the number again. An empty name, or that of the
    /// performer's own number, takes the given name away.
    ///
    /// # Errors
    /// The name of another number.
    pub fn give(&mut self, performer: PerformerId, name: &str) -> Result<(), NumberName> {
        let is_own = name == performer.to_string();
        if PerformerId::is_name(name) && !is_own {
            return Err(NumberName(name.to_owned()));
        }
        if let Some(PerformerId(before)) = self.owner(name) {
            self.given[before].clear();
        }
        let most = self.given.len().max(performer.0 + 1);
        self.given.resize(most, String::new());
        let name = if is_own { "" } else { name };
        let before = std::mem::replace(&mut self.given[performer.0], name.to_owned());
        // Nobody who enters gets a name that was taken away.
        self.waiting.retain(|waiting| *waiting != before || before == name);
        Ok(())
    }

    /// Gives the names that these performers had before.
    pub(crate) fn know(&mut self, known: &[Known]) {
        for one in known.iter().filter(|one| !one.name.is_empty()) {
            // They were names before.
            let _ = self.give(one.performer, &one.name);
        }
    }

    /// A new performer gets the next waiting name that nobody has.
    pub(crate) fn enter(&mut self, performer: PerformerId) {
        let next = self.waiting.iter().find(|name| self.owner(name).is_none()).cloned();
        if let Some(name) = next {
            // They were checked with the settings.
            let _ = self.give(performer, &name);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_is_one_performers() {
        let [first, second, third] = [0, 1, 2].map(PerformerId);
        let mut names = Names::new(vec!["lead".into(), "double".into()]);
        names.enter(second);
        assert_eq!([first, second].map(|one| names.of(one)), ["p1", "lead"]);
        names.give(first, "lead").unwrap();
        assert_eq!([first, second].map(|one| names.of(one)), ["lead", "p2"]);
        names.enter(third);
        assert_eq!((names.of(third), names.owner("double")), ("double".into(), Some(third)));
        assert!(names.give(third, "p1").is_err());
        names.give(third, "p3").unwrap();
        assert_eq!((names.given(third), names.owner("double")), (None, None));
        // It was taken away by hand.
        names.enter(PerformerId(3));
        assert_eq!(names.of(PerformerId(3)), "p4");
    }
}
