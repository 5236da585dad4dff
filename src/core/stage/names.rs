//! What the performers are called.

use super::performer_id::PerformerId;

/// The names of the performers: given ones, or p1, p2, ... by number.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Names {
    /// By number; empty: none was given.
    given: Vec<String>,
    /// For those who enter, in this order.
    waiting: Vec<String>,
}

/// A name that a performer cannot have.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is the name of a number; choose another one")]
pub struct NumberName(String);

impl Names {
    /// Names for those who enter, in this order.
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

    /// Whose name was given.
    pub fn owner(&self, name: &str) -> Option<PerformerId> {
        self.given.iter().position(|given| given == name && !name.is_empty()).map(PerformerId)
    }

    /// Gives a name; empty, or that of the performer's number: none. Whoever had it has that of the number.
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
        self.given[performer.0] = if is_own { String::new() } else { name.to_owned() };
        Ok(())
    }

    /// These have the names of before.
    pub(crate) fn know<'a>(&mut self, names: impl Iterator<Item = (PerformerId, &'a str)>) {
        for (performer, name) in names.filter(|(_, name)| !name.is_empty()) {
            // They were names before.
            let _ = self.give(performer, name);
        }
    }

    /// A new performer has entered, and gets the next name that nobody has.
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
    }
}
