//! The page that shows a stage live, or a recording, in a browser.
//!
//! [`start`] serves the page and its data over HTTP, on a thread of its own. The page gets the messages of
//! the bus as they are. A live page is a client of the bus, as any other program: a session of its own for
//! each page that is open, and none without a page. So the node does nothing for it.
//!
//! | path | answer |
//! |---|---|
//! | `/` and its files | the page, see `src/view/assets` |
//! | `/about.json` | what is shown, the fields of the messages, which events are expected, and advice on others |
//! | `/bus` | WebSocket of a live page: it sends `{"topics": [pattern, ...]}`, and gets frames; `{"take": {"id": 7, "action": "start", "name": "walk_01"}}` commands as `bundlemocap take` does |
//! | `/body.json` | what the skins of all bodies share: faces, bones and weights |
//! | `/rest?offsets=X,Y,Z,...` | the skin of a body in the rest pose, from the 66 numbers of its skeleton's offsets: x, y, z of each vertex, tenths of millimetres (`i16`) |
//! | `/overview.json` | of a recording: span, performers, events |
//! | `/messages?from=NS&to=NS&kinds=pose,provisional,keypoints,status` | of a recording: the rig and the skeletons up to `to`, and the frames of these kinds in a span of capture time |
//!
//! A frame is a message: length of the topic (`u32`), topic, capture time and time of arrival (`i64`,
//! nanoseconds), length of the payload (`u32`), payload; all numbers little-endian. Beside the messages of the
//! bus there is `mocap/{stage}/actor/{actor}/points`: where the body of a final pose has the keypoints.
//!
//! # Who may look
//! On a loopback address everybody on this computer. On any other address, those who have the token in the
//! page's address. Requests that another site makes from a browser are refused, by their `Host` and `Origin`.

mod access;
mod bus;
mod foxglove;
mod frame;
mod overview;
mod page;
mod points;
mod recorded;
mod server;

pub use bus::Live;
pub use foxglove::{Beside, Bridge, FoxgloveFile, bridge};
pub use overview::Overview;
pub use recorded::Recorded;
pub use server::{Running, Source, ViewError, start};
