//! Many takes with HyperQueue.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};
use std::time::SystemTime;

use crate::support::skipped;

const TAKES: usize = 12;
/// The take that is cut off.
const CUT: usize = 7;

/// Solves takes with two workers: OUT, PROGRAM, the number of solved takes after which everything is killed (0: never),
/// TAKES. The last line has the numbers of the failed tasks.
const SOLVE: &str = r#"
import os, pathlib, signal, sys, threading, time
from hyperqueue import Job, LocalCluster
from hyperqueue.cluster import WorkerConfig

out, program, most, *takes = sys.argv[1:]

def kill():
    while sum(path.stat().st_size > 0 for path in pathlib.Path(out).glob("*/manifest.json")) < int(most):
        time.sleep(0.005)
    os.kill(os.getpid(), signal.SIGKILL)

if int(most):
    threading.Thread(target=kill, daemon=True).start()
with LocalCluster() as cluster:
    for _ in range(2):
        cluster.start_worker(WorkerConfig(cores=1))
    job = Job(max_fails=None)
    for take in takes:
        job.program([program, "solve", take, "--out", out, "--jobs", "1"])
    client = cluster.client()
    submitted = client.submit(job)
    whole = client.wait_for_jobs([submitted], raise_on_error=False)
    print("failed:", *([] if whole else sorted(client.get_failed_tasks(submitted))))
"#;

fn bundlemocap() -> Command {
    Command::new(env!("CARGO_BIN_EXE_bundlemocap"))
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// The engine prints about itself before it.
fn last_line(output: &Output) -> String {
    text(&output.stdout).lines().last().unwrap_or_default().to_owned()
}

#[test]
fn takes_on_two_workers_are_solved_once_each_even_if_the_engine_dies() {
    let import = Command::new("python3").args(["-c", "import hyperqueue"]).output();
    if !import.is_ok_and(|output| output.status.success()) {
        return skipped("pip install hyperqueue first");
    }
    let place = tempfile::tempdir().unwrap();
    let folder = |name: &str| place.path().join(name);
    let takes: Vec<_> = (0..TAKES).map(|take| folder(&format!("take{take:02}.mcap"))).collect();
    for (take, path) in takes.iter().enumerate() {
        let seed = take.to_string();
        let synth = bundlemocap()
            .args(["synth", "--seconds", "1.5", "--seed", &seed, "--out"])
            .arg(path)
            .output();
        assert!(synth.unwrap().status.success());
    }
    let bytes = fs::read(&takes[CUT]).unwrap();
    fs::write(&takes[CUT], &bytes[..bytes.len() * 2 / 3]).unwrap();

    let (by_jobs, by_cluster) = (folder("jobs"), folder("cluster"));
    let jobs = bundlemocap()
        .arg("solve")
        .args(&takes)
        .args(["--jobs", "2", "--out"])
        .arg(&by_jobs)
        .output()
        .unwrap();
    assert_eq!(jobs.status.code(), Some(6), "{}", text(&jobs.stderr));

    let cluster = |most: &str| -> Output {
        let mut python = Command::new("python3");
        python
            .args(["-c", SOLVE])
            .arg(&by_cluster)
            .arg(env!("CARGO_BIN_EXE_bundlemocap"))
            .arg(most)
            .args(&takes);
        python.current_dir(place.path()).output().unwrap()
    };
    let killed = cluster("3");
    assert_eq!(killed.status.code(), None, "{}", text(&killed.stderr));
    // What was being solved then ends too, sooner or later.
    let of =
        |folder: &Path, take: usize, name: &str| folder.join(format!("take{take:02}")).join(name);
    for manifest in
        (0..TAKES).filter_map(|take| fs::File::open(of(&by_cluster, take, "manifest.json")).ok())
    {
        manifest.lock().unwrap();
    }
    let failed = format!("failed: {CUT}");
    let again = cluster("0");
    assert_eq!(last_line(&again), failed, "{}", text(&again.stderr));
    let solved_at = || -> Vec<SystemTime> {
        let at =
            |take| fs::metadata(of(&by_cluster, take, "poses.mcap")).unwrap().modified().unwrap();
        (0..TAKES).map(at).collect()
    };
    let before = solved_at();
    for take in 0..TAKES {
        let [mine, theirs] =
            [&by_jobs, &by_cluster].map(|folder| fs::read(of(folder, take, "poses.mcap")).unwrap());
        assert!(mine == theirs, "take {take}");
    }
    let third = cluster("0");
    assert_eq!((last_line(&third), solved_at()), (failed, before));
}
