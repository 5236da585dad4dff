//! Certificates and access control, with the files of `config/`.

use std::net::TcpListener;
use std::path::Path;
use std::process::Command;
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use bundlemocap::config::Config;
use bundlemocap::core::time::Timestamp;
use bundlemocap::io::bus::{Bus, Guard, Sample, TlsConfig, Zenoh, ZenohConfig};

/// Longest wait for an expected message.
const LONG: Duration = Duration::from_secs(20);
const KEYPOINTS: &str = "mocap/stage/camera/cam01/keypoints";

fn certificates(folder: &Path, names: &[&str]) {
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/config/certificates.sh");
    let made = Command::new("sh").arg(script).arg(folder).args(names).status().unwrap();
    assert!(made.success(), "the script needs openssl");
}

fn tls(folder: &Path, name: &str) -> TlsConfig {
    let file = |file: &str| folder.join(file).display().to_string();
    TlsConfig {
        root_ca: file("ca.pem"),
        certificate: file(&format!("{name}.pem")),
        key: file(&format!("{name}.key.pem")),
        client_certificates: true,
    }
}

fn listen(bus: &Zenoh, pattern: &str) -> (Receiver<Sample>, Box<dyn Guard>) {
    let (sender, samples) = channel();
    let sink = Box::new(move |sample| drop(sender.send(sample)));
    (samples, bus.subscribe(pattern, sink).unwrap())
}

#[test]
fn only_allowed_certificates_publish() {
    if Command::new("openssl").arg("version").output().is_err() {
        return crate::support::skipped("install openssl first");
    }
    let folder = tempfile::tempdir().unwrap();
    let (ours, theirs) = (folder.path().join("ours"), folder.path().join("theirs"));
    certificates(&ours, &["node", "cam01", "cam02", "operator", "viewer", "solver"]);
    certificates(&theirs, &["cam01"]);
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/config/studio-secure");
    let secure = Config::load(format!("{file}.toml").as_ref()).unwrap().bus.zenoh;
    let node = Zenoh::open_node(&ZenohConfig {
        listen: vec!["quic/127.0.0.1:0".into()],
        config: format!("{file}.json5"),
        tls: tls(&ours, "node"),
        ..secure
    });
    let node = node.unwrap();
    let connect = node.listens_on();
    assert!(connect[0].starts_with("quic/"), "{connect:?}");
    let client = |tls: TlsConfig| {
        Zenoh::open_client(&ZenohConfig { connect: connect.clone(), tls, ..Default::default() })
    };

    let root_ca = || tls(&ours, "node").root_ca;
    let nobody = TlsConfig { root_ca: root_ca(), ..TlsConfig::default() };
    let stranger = TlsConfig { root_ca: root_ca(), ..tls(&theirs, "cam01") };
    let trusts_others = TlsConfig { root_ca: tls(&theirs, "cam01").root_ca, ..tls(&ours, "cam01") };
    let no_key = TlsConfig { key: String::new(), ..tls(&ours, "cam01") };
    let absent = tls(&ours, "cam07");
    let swapped = TlsConfig { key: tls(&ours, "cam02").key, ..tls(&ours, "cam01") };
    for (wrong, why) in [
        (nobody, "it wants a certificate"),
        (stranger, "it does not accept [bus.zenoh.tls] certificate"),
        (trusts_others, "is not signed by the authority in [bus.zenoh.tls] root_ca"),
        (no_key, "zenoh.tls.key = \"\": certificate and key are given together"),
        (absent, "cam07.pem"),
        (swapped, "keys"),
    ] {
        let error = client(wrong).err().unwrap().to_string();
        assert!(error.contains(why), "{why}: {error}");
    }
    let node_on = |address: &str| {
        let (listen, tls) = (vec![address.into()], tls(&ours, "node"));
        Zenoh::open_node(&ZenohConfig { listen, tls, ..ZenohConfig::default() }).unwrap()
    };
    let (elsewhere, silent) =
        (node_on("quic/127.0.0.2:0"), TcpListener::bind("127.0.0.1:0").unwrap());
    for (address, why) in [
        (format!("tcp/{}", silent.local_addr().unwrap()), "is no node"),
        (elsewhere.listens_on()[0].clone(), "does not hold for the name 127.0.0.2"),
    ] {
        let tls = tls(&ours, "cam01");
        let config = ZenohConfig { connect: vec![address], tls, ..ZenohConfig::default() };
        let error = Zenoh::open_client(&config).err().unwrap().to_string();
        assert!(error.contains(why), "{why}: {error}");
    }

    let [camera, other, operator, viewer] =
        ["cam01", "cam02", "operator", "viewer"].map(|name| client(tls(&ours, name)).unwrap());
    let (heard, _guard) = listen(&node, "mocap/**");
    let (seen, _guard) = listen(&viewer, "mocap/stage/actor/actor/pose");
    let put = |bus: &Zenoh, topic: &str, payload: &[u8]| {
        bus.publisher(topic).unwrap().put(Timestamp::default(), "", payload).unwrap();
    };
    // What is forbidden goes first, so that it would arrive before what is allowed.
    let arrives = (0..200).any(|_| {
        for (bus, topic) in [
            (&viewer, KEYPOINTS),
            (&other, KEYPOINTS),
            (&camera, "mocap/stage/rig"),
            (&camera, "mocap/stage/take"),
            (&operator, KEYPOINTS),
        ] {
            put(bus, topic, b"forbidden");
        }
        put(&camera, "mocap/stage/actor/actor/pose", b"forbidden");
        put(&camera, KEYPOINTS, b"allowed");
        heard.recv_timeout(LONG / 200).is_ok_and(|sample| {
            assert_eq!((&*sample.topic, &*sample.payload), (KEYPOINTS, &b"allowed"[..]));
            true
        })
    });
    assert!(arrives, "the camera's keypoints do not arrive");
    std::thread::sleep(Duration::from_millis(300));
    assert!(heard.try_iter().all(|sample| *sample.payload == b"allowed"[..]));
    let arrives = (0..200).any(|_| {
        put(&operator, "mocap/stage/take", b"allowed");
        heard.recv_timeout(LONG / 200).is_ok_and(|sample| &*sample.topic == "mocap/stage/take")
    });
    assert!(arrives, "the operator's take does not arrive");
    let arrives = (0..200).any(|_| {
        put(&node, "mocap/stage/actor/actor/pose", b"pose");
        seen.recv_timeout(LONG / 200).is_ok_and(|sample| *sample.payload == b"pose"[..])
    });
    assert!(arrives, "the viewer sees no poses");
    let solver = client(tls(&ours, "solver")).unwrap();
    let _tokens = [(&viewer, "viewer"), (&solver, "solver")]
        .map(|(bus, name)| bus.announce(&format!("mocap/stage/solver/{name}")).unwrap());
    let arrives = (0..200).any(|_| {
        put(&viewer, "mocap/stage/actor/p1/hand_over", b"forbidden");
        put(&solver, "mocap/stage/actor/p1/hand_over", b"allowed");
        heard.recv_timeout(LONG / 200).is_ok_and(|sample| sample.topic.ends_with("/hand_over"))
    });
    assert!(arrives, "the solver's state does not arrive");
    assert!(heard.try_iter().all(|sample| *sample.payload != b"forbidden"[..]));
    let solvers = node.announced("mocap/stage/solver/*").unwrap();
    assert_eq!(solvers, ["mocap/stage/solver/solver"]);
    let (_, _guard) = listen(&operator, "mocap/stage/actor/*/status");
    let is_seen = (0..200).any(|_| {
        std::thread::sleep(LONG / 200);
        let receivers = viewer.receivers("mocap/stage/actor").unwrap();
        receivers.iter().any(|one| one.patterns.contains("mocap/stage/actor/*/status"))
    });
    assert!(is_seen, "the viewer does not see who receives");
}
