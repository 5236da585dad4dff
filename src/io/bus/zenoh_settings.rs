//! Settings of a zenoh session, and why one cannot be opened.

use std::net::{TcpListener, ToSocketAddrs, UdpSocket};

use zenoh::config::EndPoint;

use super::certificates::{Certificates, refusal};
use super::{BusError, TlsConfig, ZenohConfig};

/// Time in which a client tries to connect, milliseconds.
const CONNECT_MS: u64 = 2000;

/// Time that the node waits on a subscriber's full queue before it drops a sample, microseconds. A
/// stalled or slow subscriber delays each pose to the others by this.
const NODE_WAITS_US: u64 = 1000;

/// The same for a tool, which has one connection: it is better that a camera waits than that it drops.
const TOOL_WAITS_US: u64 = 20_000;

/// Larger messages are dropped while they are received, bytes: twice the largest that is used.
const MOST_BYTES: usize = 2 << 20;

/// Protocols of addresses that are built in. Not zenoh's tls/: it reads and writes one connection from two threads
/// (issue 2557 of zenoh). Under full load a program crashed after some minutes.
const PROTOCOLS: [&str; 2] = ["tcp/", "quic/"];

pub(super) fn check_endpoints(key: &'static str, endpoints: &[String]) -> Result<(), BusError> {
    for endpoint in endpoints {
        if let Err(error) = endpoint.parse::<EndPoint>() {
            let reason = without_places(&error);
            let reason = format!("{reason}; give an address such as tcp/127.0.0.1:7447");
            return Err(BusError::Setting { key, value: endpoint.clone(), reason });
        }
        if !PROTOCOLS.iter().any(|protocol| endpoint.starts_with(protocol)) {
            let reason = format!("only {} are built in", PROTOCOLS.join(" and "));
            return Err(BusError::Setting { key, value: endpoint.clone(), reason });
        }
    }
    Ok(())
}

/// The settings of a session: those of the file, the certificates, and what this program needs.
pub(super) fn settings(
    config: &ZenohConfig,
    mode: &str,
    listen: &[String],
    connect: &[String],
    scouting: bool,
) -> Result<zenoh::Config, BusError> {
    let list = |endpoints: &[String]| {
        format!("{:?}", endpoints.iter().map(|one| in_order(one)).collect::<Vec<_>>())
    };
    let queue = "transport/link/tx/queue";
    let wait = if mode == "client" { TOOL_WAITS_US } else { NODE_WAITS_US };
    let mut settings = vec![
        ("mode".to_owned(), format!("{mode:?}")),
        ("listen/endpoints".into(), list(listen)),
        ("connect/endpoints".into(), list(connect)),
        ("scouting/multicast/enabled".into(), scouting.to_string()),
        ("scouting/gossip/enabled".into(), scouting.to_string()),
        ("scouting/timeout".into(), CONNECT_MS.to_string()),
        ("timestamping/enabled".into(), "false".into()),
        ("transport/unicast/open_timeout".into(), CONNECT_MS.to_string()),
        ("transport/link/rx/max_message_size".into(), MOST_BYTES.to_string()),
        (format!("{queue}/congestion_control/drop/wait_before_drop"), wait.to_string()),
        (format!("{queue}/size/real_time"), "16".into()),
        (format!("{queue}/size/data"), "16".into()),
    ];
    if mode == "client" {
        settings.push(("connect/timeout_ms".into(), CONNECT_MS.to_string()));
    }
    let TlsConfig { root_ca, certificate, key, client_certificates } = &config.tls;
    let files = [
        ("root_ca_certificate", root_ca),
        ("listen_certificate", certificate),
        ("connect_certificate", certificate),
        ("listen_private_key", key),
        ("connect_private_key", key),
    ];
    for (name, file) in files.into_iter().filter(|(_, file)| !file.is_empty()) {
        settings.push((format!("transport/link/tls/{name}"), format!("{file:?}")));
    }
    if !root_ca.is_empty() {
        let mutual = *client_certificates && (mode != "client" || !certificate.is_empty());
        settings.push(("transport/link/tls/enable_mtls".into(), mutual.to_string()));
    }
    let mut zenoh = match config.config.as_str() {
        // Its access control is the node's: a tool would apply it to itself.
        file if mode != "client" && !file.is_empty() => {
            zenoh::Config::from_file(file).map_err(|error| BusError::Setting {
                key: "zenoh.config",
                value: file.into(),
                reason: without_places(&error),
            })?
        }
        _ => zenoh::Config::default(),
    };
    for (key, value) in &settings {
        zenoh.insert_json5(key, value).map_err(|error| {
            BusError::transport(format!("zenoh's {key} = {value}"), without_places(&error))
        })?;
    }
    Ok(zenoh)
}

/// The address with one stream for all messages. On several, a message may overtake the declaration of its topic.
fn in_order(endpoint: &str) -> String {
    if !endpoint.starts_with("quic/") || endpoint.contains("multistream=") {
        return endpoint.to_owned();
    }
    let (address, options) = endpoint.split_at(endpoint.find('#').unwrap_or(endpoint.len()));
    let sign = if address.contains('?') { ';' } else { '?' };
    format!("{address}{sign}multistream=0{options}")
}

pub(super) fn why_not_open(
    mode: &str,
    listen: &[String],
    connect: &[String],
    certificates: Option<&Certificates>,
    error: &str,
) -> BusError {
    if let Some(endpoint) = listen.iter().find(|endpoint| is_in_use(endpoint)) {
        return BusError::InUse { endpoint: endpoint.clone() };
    }
    if mode != "client" {
        return BusError::transport("cannot open the network", error);
    }
    for endpoint in connect {
        if let Some(reason) = refusal(endpoint, certificates) {
            return BusError::Refused { endpoint: endpoint.clone(), reason };
        }
    }
    let endpoints =
        if connect.is_empty() { "any multicast address".into() } else { connect.join(", ") };
    BusError::NobodyAnswers { endpoints }
}

/// Whether an address of this host is in use.
fn is_in_use(endpoint: &str) -> bool {
    let address = endpoint.split(['?', '#']).next().unwrap_or_default();
    let Some((protocol, address)) = address.split_once('/') else { return false };
    let Ok(mut addresses) = address.to_socket_addrs() else { return false };
    addresses.any(|address| {
        let bound = match protocol {
            "tcp" => TcpListener::bind(address).map(drop),
            _ => UdpSocket::bind(address).map(drop),
        };
        bound.is_err_and(|error| error.kind() == std::io::ErrorKind::AddrInUse)
    })
}

/// The text of a zenoh error without source locations, such as ` at /path/to/file.rs:12.`.
pub(super) fn without_places(error: &dyn std::fmt::Display) -> String {
    let (text, is_digit) = (error.to_string(), |c: char| c.is_ascii_digit());
    let mut parts = text.split(" at ");
    let mut clean = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        match part.split_once(".rs:") {
            Some((path, rest)) if !path.contains(' ') && rest.starts_with(is_digit) => {
                let rest = rest.trim_start_matches(is_digit);
                clean += rest.strip_prefix('.').unwrap_or(rest);
            }
            _ => {
                clean += " at ";
                clean += part;
            }
        }
    }
    clean
}

#[cfg(test)]
mod tests {
    use super::super::Zenoh;
    use super::*;

    #[test]
    fn an_encrypted_address_has_one_stream() {
        for (given, used) in [
            ("quic/a:1", "quic/a:1?multistream=0"),
            ("quic/a:1#iface=eth0", "quic/a:1?multistream=0#iface=eth0"),
            ("quic/a:1?prio=6-7#x=y", "quic/a:1?prio=6-7;multistream=0#x=y"),
            ("quic/a:1?multistream=1", "quic/a:1?multistream=1"),
            ("tcp/a:1", "tcp/a:1"),
        ] {
            assert_eq!(in_order(given), used);
        }
    }

    #[test]
    fn errors_show_no_paths_of_sources() {
        for (raw, clean) in [
            (
                "no route at /root/.cargo/registry/src/x-1.0/src/a.rs:12. - Caused by refused at \
                 /b/c.rs:3.",
                "no route - Caused by refused",
            ),
            ("nothing at tcp/1.2.3.4:5 at src/d.rs:7.", "nothing at tcp/1.2.3.4:5"),
            ("look at file.rs: it is at fault", "look at file.rs: it is at fault"),
        ] {
            assert_eq!(without_places(&raw), clean);
        }
        let error = Zenoh::open_node(&ZenohConfig {
            listen: vec!["tcp/no-such-host.invalid:1".into()],
            ..ZenohConfig::default()
        });
        let error = error.err().unwrap().to_string();
        assert!(!error.contains(".rs"), "{error}");
    }
}
