//! Rules for topics and patterns, the same on every bus.

use super::BusError;

/// Longest topic or pattern, bytes. Names of services in shared memory are limited.
pub(crate) const LONGEST_TOPIC: usize = 200;

/// Checks a topic: parts between slashes, no empty part, no `*`, `$`, `?` or `#`, no part that
/// begins with `@`, no control characters, at most 200 bytes.
///
/// # Errors
/// The name is not a topic; the error holds the reason.
pub fn check_topic(name: &str) -> Result<(), BusError> {
    check(name, "topic", |part| match part.contains('*') {
        true => Some("a topic has no *, only patterns have"),
        false => None,
    })
}

/// Checks a pattern: like a topic, but parts may also be `*` and `**`.
///
/// # Errors
/// The name is not a pattern; the error holds the reason.
pub fn check_pattern(name: &str) -> Result<(), BusError> {
    check(name, "pattern", |part| match part.contains('*') && part != "*" && part != "**" {
        true => Some("* and ** must be whole parts"),
        false => None,
    })
}

fn check(
    name: &str,
    what: &'static str,
    stars: impl Fn(&str) -> Option<&'static str>,
) -> Result<(), BusError> {
    let reason = if name.len() > LONGEST_TOPIC {
        Some("it is longer than 200 bytes")
    } else {
        name.split('/').find_map(|part| wrong_with(part).or_else(|| stars(part)))
    };
    match reason {
        None => Ok(()),
        Some(reason) => Err(BusError::Name { name: name.into(), what, reason: reason.into() }),
    }
}

fn wrong_with(part: &str) -> Option<&'static str> {
    if part.is_empty() {
        Some("a part between slashes is empty")
    } else if part.contains(['$', '?', '#']) {
        Some("$, ? and # are reserved on the network")
    } else if part.starts_with('@') {
        Some("a part begins with @")
    } else if part.contains(char::is_control) {
        Some("it contains control characters")
    } else {
        None
    }
}

/// Whether a pattern matches a topic: `*` is one part, `**` any number of parts, including none.
pub fn matches(pattern: &str, topic: &str) -> bool {
    let pattern: Vec<&str> = pattern.split('/').collect();
    let topic: Vec<&str> = topic.split('/').collect();
    matches_parts(&pattern, &topic)
}

/// Backtracks only to the last `**`, so the time is at most the product of the lengths.
fn matches_parts(pattern: &[&str], topic: &[&str]) -> bool {
    let (mut p, mut t) = (0, 0);
    let mut back: Option<(usize, usize)> = None;
    while t < topic.len() {
        match pattern.get(p) {
            Some(&"**") => {
                back = Some((p, t));
                p += 1;
            }
            Some(&part) if part == "*" || part == topic[t] => {
                p += 1;
                t += 1;
            }
            _ => {
                let Some((star, from)) = back else { return false };
                back = Some((star, from + 1));
                p = star + 1;
                t = from + 1;
            }
        }
    }
    pattern[p..].iter().all(|&part| part == "**")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stars_stand_for_parts() {
        for (pattern, topic) in [
            ("a/b", "a/b"),
            ("a/*", "a/b"),
            ("**", "a"),
            ("a/**", "a"),
            ("a/**", "a/b/c"),
            ("a/**/c", "a/c"),
            ("**/x/*/y", "x/x/x/1/y"),
            ("a/**/b/**/c", "a/b/q/b/c"),
        ] {
            assert!(matches(pattern, topic), "{pattern} {topic}");
        }
        for (pattern, topic) in [
            ("a/b", "a/c"),
            ("a/*", "a"),
            ("a/*", "a/b/c"),
            ("*", "a/b"),
            ("a/**/c", "a/b"),
            ("a/b/c", "a/b"),
        ] {
            assert!(!matches(pattern, topic), "{pattern} {topic}");
        }
    }

    #[test]
    fn many_stars_take_no_long_time() {
        let pattern = ["**"; 60].join("/a/");
        let topic = ["b"; 90].join("/");
        assert!(!matches(&pattern, &topic));
    }

    #[test]
    fn names_that_cannot_be_are_refused_with_a_reason() {
        for name in ["", "/a", "a/", "a//b", "a/*/b", "a/$b", "a?b", "a#b", "a/@adv", "a\nb"] {
            assert!(check_topic(name).is_err(), "{name:?}");
        }
        for name in ["", "a//b", "a/b*", "a/***", "**a", "a/$*", "@/b"] {
            assert!(check_pattern(name).is_err(), "{name:?}");
        }
        assert!(check_topic(&"a".repeat(201)).is_err() && check_topic(&"a".repeat(200)).is_ok());
        for name in ["mocap/stage/rig", "größe/kamera 1"] {
            check_topic(name).unwrap();
            check_pattern(name).unwrap();
        }
        check_pattern("a/*/**/b").unwrap();
        let error = check_topic("a/*").unwrap_err().to_string();
        assert_eq!(error, "\"a/*\" is not a topic: a topic has no *, only patterns have");
    }
}
