//! The server of the page, on a thread of its own.

use std::collections::BTreeMap;
use std::io;
use std::net::{SocketAddr, TcpListener, ToSocketAddrs};
use std::sync::{Arc, OnceLock};
use std::thread::JoinHandle;

use axum::extract::{Query, State, WebSocketUpgrade};
use axum::http::StatusCode;
use axum::http::header::CONTENT_TYPE;
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use axum::{Router, middleware};
use nalgebra::Vector3;
use serde::Deserialize;
use serde_json::json;
use tokio::sync::{Semaphore, oneshot};
use tokio::task::{JoinError, spawn_blocking};

use super::access::{self, Access};
use super::bus::{self, Live};
use super::page;
use super::recorded::Recorded;
use crate::core::body::{JOINTS, Skeleton};
use crate::core::time::Timestamp;
use crate::core::tracker::EventKind;
use crate::io::recording::RecordError;
use crate::io::report;
use crate::live::{USED_AGAIN, advice, is_expected};

/// Why the page cannot be served. Its text says what is wrong, with units.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)]
pub enum ViewError {
    #[error(
        "cannot serve the page on {address:?}: {source}; give a free address and port, such as \
         127.0.0.1:8765"
    )]
    Listen { address: String, source: io::Error },
    #[error(
        "cannot serve Foxglove on {address:?}: {source}; give a free address and port, such as \
         127.0.0.1:8766"
    )]
    Bridge { address: String, source: io::Error },
    #[error("cannot start a thread: {0}; raise the limit of processes")]
    Thread(io::Error),
    /// The recording cannot be read.
    #[error(transparent)]
    Recording(#[from] RecordError),
}

/// What the page shows.
#[derive(Clone)]
pub enum Source {
    /// A stage on the bus.
    Live(Arc<Live>),
    /// A recording.
    Recorded(Arc<Recorded>),
}

/// A page that is served until this is dropped.
pub struct Running {
    address: SocketAddr,
    token: Option<String>,
    stop: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Running {
    /// The address to open in a browser, with the token if it needs one. With an address for all networks, that
    /// of this computer by its name.
    pub fn url(&self) -> String {
        let token = self.token.as_ref().map_or_else(String::new, |token| format!("?token={token}"));
        format!("http://{}/{token}", reachable(self.address))
    }
}

/// The address for other computers: host name and port if the server listens on all networks.
pub(super) fn reachable(address: SocketAddr) -> String {
    match address.ip().is_unspecified() {
        true => {
            let system = rustix::system::uname();
            format!("{}:{}", system.nodename().to_string_lossy(), address.port())
        }
        false => address.to_string(),
    }
}

/// The calling thread gives way to the solver.
pub(super) fn give_way() {
    #[cfg(target_os = "linux")]
    let _ = rustix::process::nice(19);
}

impl Drop for Running {
    fn drop(&mut self) {
        drop(self.stop.take());
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Serves the page on `address`, such as `127.0.0.1:8765`; port 0 chooses a free one.
///
/// # Errors
/// The address is in use or not of this computer.
pub fn start(address: &str, source: Source) -> Result<Running, ViewError> {
    let refused = |source| ViewError::Listen { address: address.to_owned(), source };
    let resolved: Vec<SocketAddr> = address.to_socket_addrs().map_err(refused)?.collect();
    let listener = TcpListener::bind(&*resolved).map_err(refused)?;
    listener.set_nonblocking(true).map_err(refused)?;
    let address = listener.local_addr().map_err(refused)?;
    let access = Access::of(address, matches!(source, Source::Live(_)));
    let (token, (stop, stopped)) = (access.token.clone(), oneshot::channel());
    let router = router(access, source);
    let serve = move || {
        give_way();
        let mut builder = tokio::runtime::Builder::new_current_thread();
        let Ok(runtime) = builder.enable_io().enable_time().build() else { return };
        runtime.block_on(async {
            let Ok(listener) = tokio::net::TcpListener::from_std(listener) else { return };
            tokio::select! {
                served = axum::serve(listener, router).into_future() => {
                    if let Err(error) = served {
                        tracing::warn!("the page is no longer served: {error}");
                    }
                }
                _ = stopped => {}
            }
        });
        runtime.shutdown_background();
    };
    let thread = std::thread::Builder::new().name("view".into()).spawn(serve);
    let thread = Some(thread.map_err(ViewError::Thread)?);
    Ok(Running { address, token, stop: Some(stop), thread })
}

/// The number of requests that read a recording at a time.
static READERS: Semaphore = Semaphore::const_new(4);

fn router(access: Access, source: Source) -> Router {
    Router::new()
        .route("/about.json", get(about))
        .route("/bus", get(live))
        .route("/body.json", get(body))
        .route("/rest", get(rest))
        .route("/overview.json", get(overview))
        .route("/messages", get(messages))
        .fallback(get(page::file))
        .with_state(source)
        .layer(middleware::from_fn_with_state(access, access::check))
}

async fn body() -> Response {
    static TEXT: OnceLock<String> = OnceLock::new();
    let text = || TEXT.get_or_init(|| report::body::template().to_string()).as_str();
    answer("application/json", spawn_blocking(text).await)
}

/// What a blocking task has made.
fn answer<T: IntoResponse>(kind: &'static str, made: Result<T, JoinError>) -> Response {
    let ok = |content| ([(CONTENT_TYPE, kind)], content).into_response();
    made.map_or_else(|error| failed(&error), ok)
}

/// A body whose skin is wanted.
#[derive(Deserialize)]
struct Rest {
    /// Each joint's offset from its parent, metres: 66 numbers with commas between them.
    offsets: String,
}

async fn rest(Query(Rest { offsets }): Query<Rest>) -> Response {
    let number = |text: &str| text.parse().ok().filter(|x: &f64| x.abs() < 1.0);
    let numbers: Option<Vec<f64>> = offsets.split(',').map(number).collect();
    match numbers.filter(|numbers| numbers.len() == 3 * JOINTS) {
        Some(numbers) => {
            let offset = |j: usize| Vector3::from_column_slice(&numbers[3 * j..3 * j + 3]);
            let body = Skeleton::with_joint_offsets(std::array::from_fn(offset));
            let skin = spawn_blocking(move || report::body::rest(&body)).await;
            answer("application/octet-stream", skin)
        }
        None => {
            let reason = format!(
                "offsets must be {} numbers with commas between them, each between -1 and 1 (metres)\n",
                3 * JOINTS
            );
            (StatusCode::BAD_REQUEST, reason).into_response()
        }
    }
}

async fn about(State(source): State<Source>) -> Response {
    let names = || EventKind::ALL.iter().map(|kind| kind.name());
    let expected: Vec<&str> = names().filter(|kind| is_expected(kind)).collect();
    let advice = names().filter_map(|kind| Some((kind, advice(kind)?)));
    let (shows, name, node) = match &source {
        Source::Live(live) => ("live", live.topics.stage.clone(), Some(&*live.topics.actor)),
        Source::Recorded(recorded) => ("recording", recorded.name(), None),
    };
    let about = json!({
        "version": env!("CARGO_PKG_VERSION"),
        "shows": shows,
        "name": name,
        "node": node,
        "expected": expected,
        "used_again": USED_AGAIN,
        "advice": advice.collect::<BTreeMap<_, _>>(),
    });
    let fields = include_str!(concat!(env!("OUT_DIR"), "/messages.json"));
    as_json(format!("{{\"about\":{about},\"messages\":{fields}}}"))
}

fn as_json(text: String) -> Response {
    ([(CONTENT_TYPE, "application/json")], text).into_response()
}

async fn live(State(source): State<Source>, upgrade: WebSocketUpgrade) -> Response {
    match source {
        Source::Live(live) => upgrade.on_upgrade(move |socket| bus::attend(socket, live)),
        Source::Recorded(_) => missing(),
    }
}

async fn overview(State(source): State<Source>) -> Response {
    match &source {
        Source::Live(_) => missing(),
        Source::Recorded(recorded) => match serde_json::to_string(recorded.overview()) {
            Ok(text) => as_json(text),
            Err(error) => failed(&error),
        },
    }
}

/// A part of a recording: capture times, nanoseconds, and kinds with commas between.
#[derive(Deserialize)]
struct Part {
    from: i64,
    to: i64,
    kinds: String,
}

async fn messages(State(source): State<Source>, Query(part): Query<Part>) -> Response {
    let Source::Recorded(recorded) = source else { return missing() };
    let span = [part.from, part.to].map(Timestamp::from_ns);
    let Ok(_permit) = READERS.acquire().await else { return missing() };
    // Reading may take a while; other requests are answered meanwhile.
    let read = move || recorded.frames(span, &part.kinds.split(',').collect::<Vec<_>>());
    match spawn_blocking(read).await {
        Ok(Err(error)) => failed(&error),
        made => answer("application/octet-stream", made.map(Result::unwrap_or_default)),
    }
}

fn failed(error: &dyn std::error::Error) -> Response {
    (StatusCode::INTERNAL_SERVER_ERROR, error.to_string()).into_response()
}

fn missing() -> Response {
    (StatusCode::NOT_FOUND, "this page does not show that\n").into_response()
}
