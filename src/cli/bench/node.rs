//! The node of `bench latency`, in a separate process.

use std::fs::{self, File};
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};

use crate::cli::failure::{Exit, Failure};
use crate::cli::own_path;
use crate::config::Config;
use crate::io::bus::{Bus, open_client};
use crate::live::{Usage, log};

/// Longest time for the node to start, and to stop.
pub(super) const PATIENCE: Duration = Duration::from_secs(10);
const LOOK: Duration = Duration::from_millis(20);

/// The process of the node; killed if dropped while it runs.
pub(super) struct NodeProcess {
    child: Child,
    folder: tempfile::TempDir,
}

/// Settings isolated from other nodes: a free port, a unique prefix.
pub(super) fn isolated(mut config: Config) -> Result<Config, Failure> {
    let free = TcpListener::bind("127.0.0.1:0").and_then(|listener| listener.local_addr());
    let address = free.map_err(|error| {
        Failure::new(Exit::Unexpected, format!("no free port on 127.0.0.1: {error}"))
    })?;
    config.bus.zenoh.listen = vec![format!("tcp/{address}")];
    config.bus.zenoh.connect.clear();
    config.bus.zenoh.scouting = false;
    config.bus.iceoryx2.prefix = format!("bench_{}_", std::process::id());
    config.node.stage = "bench".into();
    config.node.actor = "actor".into();
    config.node.rig.clear();
    config.node.prometheus.clear();
    (config.bus.zenoh.mode, config.bus.zenoh.tls) = Default::default();
    if config.stage.performers.limit() > 1 || config.node.solver {
        let why = "bench latency measures one performer: remove [stage] performers and [node] \
                   solver from the settings";
        return Err(Failure::new(Exit::Usage, why));
    }
    Ok(config)
}

impl NodeProcess {
    /// Starts this program as a node that stops after `seconds` at the latest.
    pub(super) fn start(config: &Config, seconds: f64) -> Result<Self, Failure> {
        let failed = |what: &str, error: std::io::Error| {
            Failure::new(Exit::Unexpected, format!("cannot {what}: {error}"))
        };
        let folder = tempfile::tempdir().map_err(|error| failed("make a folder", error))?;
        let settings = folder.path().join("node.toml");
        fs::write(&settings, config.to_toml()).map_err(|error| failed("write settings", error))?;
        let log = File::create(log_path(folder.path()))
            .map_err(|error| failed("write the node's log", error))?;
        let program = own_path().map_err(|error| failed("find this program", error))?;
        let mut command = Command::new(program);
        if std::env::var_os(log::VARIABLE).is_none() {
            command.env(log::VARIABLE, "warn");
        }
        let child = (command.arg("run").arg(&settings))
            .args(["--seconds", &seconds.to_string()])
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(log)
            .spawn()
            .map_err(|error| failed("start the node", error))?;
        Ok(Self { child, folder })
    }

    /// Connects to the node as soon as it answers.
    pub(super) fn connect(&mut self, config: &Config) -> Result<Box<dyn Bus>, Failure> {
        let begin = Instant::now();
        loop {
            self.check()?;
            match open_client(&config.bus) {
                Ok(bus) => return Ok(bus),
                Err(error) if begin.elapsed() > PATIENCE => return Err(error.into()),
                Err(_) => std::thread::sleep(LOOK),
            }
        }
    }

    /// The resource usage of the process so far.
    pub(super) fn usage(&self) -> Option<Usage> {
        Usage::of(Some(self.child.id()))
    }

    /// Fails if the process has ended.
    pub(super) fn check(&mut self) -> Result<(), Failure> {
        match self.child.try_wait() {
            Ok(Some(status)) => Err(self.ended_early(status)),
            _ => Ok(()),
        }
    }

    /// The node's log.
    pub(super) fn log(&self) -> String {
        fs::read_to_string(log_path(self.folder.path())).unwrap_or_default()
    }

    /// Stops the node and waits until it has ended.
    pub(super) fn stop(mut self) -> Result<(), Failure> {
        self.check()?;
        if let Some(pid) = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw) {
            let _ = kill_process(pid, Signal::TERM);
        }
        let begin = Instant::now();
        while begin.elapsed() < PATIENCE {
            match self.child.try_wait() {
                Ok(Some(status)) if status.success() => return Ok(()),
                Ok(Some(status)) => return Err(self.ended_early(status)),
                _ => std::thread::sleep(LOOK),
            }
        }
        let message = format!("the node has not stopped within {PATIENCE:?} of SIGTERM");
        Err(Failure::new(Exit::Unexpected, message))
    }

    fn ended_early(&self, status: ExitStatus) -> Failure {
        let log = self.log();
        let last = log.lines().last().unwrap_or("its log is empty");
        Failure::new(Exit::Unexpected, format!("the node ended ({status}): {last}"))
    }
}

impl Drop for NodeProcess {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn log_path(folder: &Path) -> PathBuf {
    folder.join("node.log")
}
