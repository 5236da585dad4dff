//! Who receives what.

use serde::Serialize;

/// A program that subscribes to topics.
#[derive(Clone, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct Receiver {
    /// What it calls itself, such as `bundlemocap record`; empty if it does not say.
    pub name: String,
    /// Address of its computer, number of its process, or else its number on the bus.
    pub place: String,
    /// The patterns that it subscribes to, sorted.
    pub patterns: Vec<String>,
}

/// What a program is called if nothing is set: the name of its file.
pub(super) fn name_or_file(name: &str) -> String {
    if !name.is_empty() {
        return name.to_owned();
    }
    let file = std::env::current_exe().unwrap_or_default();
    file.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

#[cfg(feature = "zenoh")]
pub(super) use admin::of_admin_space;

/// Zenoh's admin space: what sessions say of themselves and of those beside them.
#[cfg(feature = "zenoh")]
mod admin {
    use std::collections::{BTreeMap, BTreeSet};

    use serde_json::Value;

    use super::Receiver;

    /// The receivers, except `own`, from the answers under `@/*/*/subscriber/` and `@/*/*`: keys and JSON.
    pub(in super::super) fn of_admin_space(
        subscribers: &[(String, Value)],
        sessions: &[(String, Value)],
        own: &str,
    ) -> Vec<Receiver> {
        let mut patterns = BTreeMap::<&str, BTreeSet<&str>>::new();
        for (key, sources) in subscribers {
            let Some((_, pattern)) = key.split_once("/subscriber/") else { continue };
            // Helpers of zenoh-ext: heartbeats of states.
            if pattern.contains("/@adv/") {
                continue;
            }
            // Routers pass on what their own clients and peers want, and answer for these themselves.
            let of = ["peers", "clients"].map(|kind| sources[kind].as_array());
            for id in of.into_iter().flatten().flatten().filter_map(Value::as_str) {
                patterns.entry(id).or_default().insert(pattern);
            }
        }
        patterns.remove(own);
        let receiver = |(id, patterns): (&str, BTreeSet<&str>)| Receiver {
            name: name(sessions, id).unwrap_or_default(),
            place: host(sessions, id).unwrap_or_else(|| id.to_owned()),
            patterns: patterns.into_iter().map(str::to_owned).collect(),
        };
        patterns.into_iter().map(receiver).collect()
    }

    /// What a session says in its metadata.
    fn name(sessions: &[(String, Value)], id: &str) -> Option<String> {
        let own = sessions.iter().find(|(_, about)| about["zid"] == id);
        Some(own?.1["metadata"]["name"].as_str()?.to_owned())
    }

    /// Where others see a session connected.
    fn host(sessions: &[(String, Value)], id: &str) -> Option<String> {
        let others = sessions.iter().filter_map(|(_, about)| about["sessions"].as_array());
        let beside = others.flatten().find(|beside| beside["peer"] == id)?;
        let address = beside["links"][0]["dst"].as_str()?;
        // `tcp/192.168.1.20:51234`
        let (_, address) = address.split_once('/')?;
        Some(address.rsplit_once(':').map_or(address, |(host, _)| host).to_owned())
    }
}

#[cfg(all(test, feature = "zenoh"))]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn a_program_that_says_nothing_of_itself_has_an_address() {
        let subscribers = [
            (
                "@/a1/router/subscriber/mocap/s/actor/*/pose".into(),
                json!({ "clients": ["b2", "c3"] }),
            ),
            (
                "@/a1/router/subscriber/mocap/**".into(),
                json!({ "clients": ["b2"], "peers": ["d4"] }),
            ),
            ("@/b2/client/subscriber/mocap/**".into(), json!({ "routers": ["a1"] })),
            ("@/a1/router/subscriber/mocap/s/actor/*/@adv/x".into(), json!({ "clients": ["e5"] })),
        ];
        let link = |to: &str| json!([{ "src": "tcp/10.0.0.1:7447", "dst": to }]);
        let sessions = [
            (
                "@/a1/router".into(),
                json!({ "zid": "a1", "metadata": null, "sessions": [
                    { "peer": "b2", "links": link("tcp/10.0.0.7:50000") },
                    { "peer": "c3", "links": link("tls/[fe80::1]:50000") },
                ] }),
            ),
            ("@/c3/client".into(), json!({ "zid": "c3", "metadata": { "name": "the page" } })),
        ];
        let one = |name: &str, place: &str, patterns: &[&str]| Receiver {
            name: name.into(),
            place: place.into(),
            patterns: patterns.iter().map(|&pattern| pattern.into()).collect(),
        };
        let pose = "mocap/s/actor/*/pose";
        let wanted = [one("", "10.0.0.7", &["mocap/**", pose]), one("", "d4", &["mocap/**"])];
        assert_eq!(of_admin_space(&subscribers, &sessions, "c3"), wanted);
        let page = one("the page", "[fe80::1]", &[pose]);
        assert!(of_admin_space(&subscribers, &sessions, "").contains(&page));
    }
}
