//! Programs that run beside a test: started, watched, and ended.

use std::io::{BufRead, BufReader, Read};
use std::net::TcpListener;
use std::process::{Child, Command, Stdio};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, RecvTimeoutError, unbounded};

/// Timeout of things that take a short time; only a failing test waits that long.
pub const PATIENCE: Duration = Duration::from_secs(120);

/// A program that ends with the test.
pub struct Program {
    child: Child,
    said: Option<JoinHandle<String>>,
    lines: Receiver<String>,
    /// Lines of standard error that were read.
    seen: Vec<String>,
}

/// The results of a program that ended.
pub struct Ended {
    pub code: Option<i32>,
    pub said: String,
    pub errors: String,
}

impl Program {
    /// Starts it; its output is kept until the end.
    pub fn start(command: &mut Command) -> Self {
        let piped = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = piped.spawn().unwrap();
        let errors = BufReader::new(child.stderr.take().unwrap());
        let mut output = child.stdout.take().unwrap();
        let said = std::thread::spawn(move || {
            let mut said = String::new();
            output.read_to_string(&mut said).unwrap();
            said
        });
        let (sender, lines) = unbounded();
        std::thread::spawn(move || {
            errors.lines().map_while(Result::ok).try_for_each(|line| sender.send(line))
        });
        Self { child, said: Some(said), lines, seen: Vec::new() }
    }

    /// Waits for a line of standard error that holds the text; false if the program ends before.
    pub fn has_said(&mut self, text: &str) -> bool {
        let deadline = Instant::now() + PATIENCE;
        loop {
            match self.lines.recv_deadline(deadline) {
                Ok(line) => {
                    self.seen.push(line);
                    if self.seen.last().is_some_and(|line| line.contains(text)) {
                        return true;
                    }
                }
                Err(RecvTimeoutError::Disconnected) => return false,
                Err(RecvTimeoutError::Timeout) => panic!("never: {text:?} in {:#?}", self.seen),
            }
        }
    }

    /// Sends a signal, such as `INT`.
    pub fn signal(&self, name: &str) {
        let signal = format!("-{name}");
        let mut kill = Command::new("kill");
        kill.args([&signal, &self.child.id().to_string()]);
        assert!(kill.status().unwrap().success());
    }

    /// Ends it, as Ctrl-C does.
    pub fn interrupt(self) -> Ended {
        self.signal("INT");
        self.ended()
    }

    /// Ends it in this way; returns its output. It ends with that exit code.
    pub fn interrupted(self, code: i32) -> String {
        let ended = self.interrupt();
        assert_eq!(ended.code, Some(code), "{}", ended.errors);
        ended.said
    }

    /// Whether it has ended.
    pub fn is_over(&mut self) -> bool {
        self.child.try_wait().unwrap().is_some()
    }

    /// Waits for the end.
    pub fn ended(mut self) -> Ended {
        let begin = Instant::now();
        while !self.is_over() {
            assert!(begin.elapsed() < PATIENCE, "it does not end: {:#?}", self.seen);
            std::thread::sleep(Duration::from_millis(5));
        }
        let said = self.said.take().unwrap().join().unwrap();
        self.seen.extend(self.lines.iter());
        let code = self.child.wait().unwrap().code();
        Ended { code, said, errors: self.seen.join("\n") }
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// An address without a listener, as of this call.
pub fn free_address() -> String {
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    format!("tcp/127.0.0.1:{port}")
}

/// A node that listens, and its address. If another program takes the port first, it tries another
/// one.
pub fn listening_node(arguments: &[&str]) -> (Program, String) {
    for _ in 0..5 {
        let address = free_address();
        let mut command = Command::new(env!("CARGO_BIN_EXE_bundlemocap"));
        let mut node =
            Program::start(command.arg("run").args(arguments).args(["--listen", &address]));
        if node.has_said("listening: ") {
            return (node, address);
        }
        let ended = node.ended();
        assert_eq!(ended.code, Some(13), "{}", ended.errors);
    }
    panic!("no port is free");
}
