//! The thread and the connections of the Prometheus endpoint.

use std::io::{self, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream, ToSocketAddrs};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{Builder, JoinHandle};
use std::time::{Duration, Instant};

use super::board::Board;
use super::metrics::Snapshot;
use super::process::Usage;
use crate::live::error::NodeError;

const TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";
/// A client has this long for its request, and as long to take the answer.
const PATIENCE: Duration = Duration::from_secs(2);
/// Longest head of a request, bytes.
const MOST_HEAD: usize = 8 << 10;
/// Most clients at once; more are turned away.
const MOST_CLIENTS: usize = 8;

/// The endpoint, with its thread. Each client has a thread of its own, which nobody waits for.
pub(crate) struct Endpoint {
    is_over: Arc<AtomicBool>,
    socket: SocketAddr,
    thread: Option<JoinHandle<()>>,
    /// The address on which it listens.
    pub(crate) address: String,
}

impl Endpoint {
    /// Listens on `address`, such as `127.0.0.1:9464`.
    pub(crate) fn start(address: &str, board: Arc<Board>) -> Result<Self, NodeError> {
        let refused = |error: io::Error| NodeError::Prometheus {
            address: address.into(),
            reason: error.to_string(),
        };
        let sockets: Vec<SocketAddr> = address.to_socket_addrs().map_err(refused)?.collect();
        let listener = TcpListener::bind(&sockets[..]).map_err(refused)?;
        let socket = listener.local_addr().map_err(refused)?;
        let is_over = Arc::<AtomicBool>::default();
        let until = Arc::clone(&is_over);
        let work = move || serve(&listener, &board, &until);
        let thread =
            Builder::new().name("metrics".into()).spawn(work).map_err(NodeError::Thread)?;
        Ok(Self { is_over, socket, thread: Some(thread), address: socket.to_string() })
    }
}

impl Drop for Endpoint {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Release);
        // The thread waits for a client: this is the last one.
        let is_woken = TcpStream::connect_timeout(&self.socket, PATIENCE).is_ok();
        if let Some(thread) = self.thread.take().filter(|_| is_woken) {
            let _ = thread.join();
        }
    }
}

fn serve(listener: &TcpListener, board: &Arc<Board>, is_over: &AtomicBool) {
    let clients = Arc::new(());
    for stream in listener.incoming() {
        if is_over.load(Ordering::Acquire) {
            return;
        }
        let (Ok(stream), true) = (stream, Arc::strong_count(&clients) <= MOST_CLIENTS) else {
            // Such as too many open files: the next try comes later.
            std::thread::sleep(Duration::from_millis(10));
            continue;
        };
        let (board, client) = (Arc::clone(board), Arc::clone(&clients));
        let work = move || {
            // An error means that the client is gone or too slow.
            let _ = answer(stream, &board);
            drop(client);
        };
        let _ = Builder::new().name("metrics client".into()).spawn(work);
    }
}

fn answer(mut stream: TcpStream, board: &Board) -> io::Result<()> {
    stream.set_write_timeout(Some(PATIENCE))?;
    let head = head(&mut stream)?;
    let mut words = head.split(' ');
    let (method, target) = (words.next().unwrap_or_default(), words.next().unwrap_or_default());
    let path = target.split('?').next().unwrap_or_default();
    let (status, kind, text) = match (method, path) {
        ("GET" | "HEAD", "/metrics") => {
            let snapshot = Snapshot {
                status: board.status(),
                stage: board.stage(),
                failures: board.publish_failures(),
                usage: Usage::of(None),
            };
            match snapshot.render() {
                Ok(text) => ("200 OK", TYPE, text),
                Err(error) => ("500 Internal Server Error", "text/plain", error.to_string()),
            }
        }
        (_, "/metrics") => ("405 Method Not Allowed", "text/plain", "use GET\n".to_owned()),
        _ => ("404 Not Found", "text/plain", "metrics are at /metrics\n".to_owned()),
    };
    let length = text.len();
    let body = if method == "HEAD" { "" } else { &text };
    write!(
        stream,
        "HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {length}\r\n\
         Connection: close\r\n\r\n{body}"
    )
}

/// The request up to its empty line.
fn head(stream: &mut TcpStream) -> io::Result<String> {
    let (begin, mut bytes, mut buffer) = (Instant::now(), Vec::new(), [0; 1024]);
    while !bytes.windows(4).any(|end| end == b"\r\n\r\n") {
        let left = PATIENCE.checked_sub(begin.elapsed()).filter(|left| !left.is_zero());
        let left = left.ok_or(io::ErrorKind::TimedOut)?;
        stream.set_read_timeout(Some(left))?;
        match stream.read(&mut buffer)? {
            0 => return Err(io::ErrorKind::UnexpectedEof.into()),
            _ if bytes.len() > MOST_HEAD => return Err(io::ErrorKind::InvalidData.into()),
            count => bytes.extend_from_slice(&buffer[..count]),
        }
    }
    Ok(String::from_utf8_lossy(&bytes).into_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_in_use_is_named() {
        let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let address = taken.local_addr().unwrap().to_string();
        let error = Endpoint::start(&address, Arc::default()).err().unwrap().to_string();
        assert!(error.contains(&address), "{error}");
        let error = Endpoint::start("nothing", Arc::default()).err().unwrap().to_string();
        assert!(error.contains("\"nothing\""), "{error}");
    }

    #[test]
    fn it_answers_and_ends() {
        let endpoint = Endpoint::start("127.0.0.1:0", Arc::default()).unwrap();
        let ask = |path: &str| {
            let mut stream = std::net::TcpStream::connect(&endpoint.address).unwrap();
            write!(stream, "GET {path} HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n").unwrap();
            let mut text = String::new();
            stream.read_to_string(&mut text).unwrap();
            text
        };
        let text = ask("/metrics");
        assert!(text.starts_with("HTTP/1.1 200") && text.contains("bundlemocap_info"), "{text}");
        assert!(ask("/").starts_with("HTTP/1.1 404"));
        drop(endpoint);
    }

    #[test]
    fn clients_that_stall_hold_nobody_up() {
        let endpoint = Endpoint::start("127.0.0.1:0", Arc::default()).unwrap();
        let connect = || TcpStream::connect(&endpoint.address).unwrap();
        let (_silent, mut half, mut body) = (connect(), connect(), connect());
        half.write_all(b"GET /metrics HT").unwrap();
        body.write_all(b"GET /metrics HTTP/1.1\r\nContent-Length: 1000000\r\n\r\n").unwrap();
        let mut text = String::new();
        body.read_to_string(&mut text).unwrap();
        assert!(text.starts_with("HTTP/1.1 200"), "{text}");
        let mut other = connect();
        other.write_all(b"HEAD /metrics HTTP/1.1\r\n\r\n").unwrap();
        text.clear();
        other.read_to_string(&mut text).unwrap();
        assert!(text.starts_with("HTTP/1.1 200") && text.ends_with("\r\n\r\n"), "{text}");
        drop(endpoint);
        // The silent ones are still connected, and are let go in the end.
        assert!(half.read(&mut [0]).is_ok_and(|bytes| bytes == 0));
    }
}
