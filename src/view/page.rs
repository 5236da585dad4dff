//! The files of the page. They are in the program, so that it works without internet.

use axum::http::header::{
    CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, X_CONTENT_TYPE_OPTIONS,
};
use axum::http::{StatusCode, Uri};
use axum::response::{IntoResponse, Response};

/// The page's own scripts and styles alone, and data from where it came.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; \
                      connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// Path, type and content of each file.
const FILES: &[(&str, &str, &str)] = &[
    ("/", "text/html; charset=utf-8", include_str!("assets/index.html")),
    ("/style.css", "text/css; charset=utf-8", include_str!("assets/style.css")),
    ("/app.js", SCRIPT, include_str!("assets/app.js")),
    ("/messages.js", SCRIPT, include_str!("assets/messages.js")),
    ("/store.js", SCRIPT, include_str!("assets/store.js")),
    ("/takes.js", SCRIPT, include_str!("assets/takes.js")),
    ("/figures.js", SCRIPT, include_str!("assets/figures.js")),
    ("/lights.js", SCRIPT, include_str!("assets/lights.js")),
    ("/colours.js", SCRIPT, include_str!("../io/report/scene/colours.js")),
    ("/body.js", SCRIPT, include_str!("../io/report/scene/body.js")),
    ("/bodies.js", SCRIPT, include_str!("assets/bodies.js")),
    ("/lens.js", SCRIPT, include_str!("../io/report/scene/lens.js")),
    ("/scene.js", SCRIPT, include_str!("../io/report/scene/scene.js")),
    ("/loop.js", SCRIPT, include_str!("../io/report/scene/loop.js")),
    ("/through.js", SCRIPT, include_str!("assets/through.js")),
    ("/panes.js", SCRIPT, include_str!("assets/panes.js")),
    ("/charts.js", SCRIPT, include_str!("assets/charts.js")),
    ("/sources.js", SCRIPT, include_str!("assets/sources.js")),
    ("/three.js", SCRIPT, include_str!("../io/report/scene/three.js")),
];
const SCRIPT: &str = "text/javascript; charset=utf-8";

pub(super) async fn file(uri: Uri) -> Response {
    let Some((_, kind, text)) = FILES.iter().find(|(path, ..)| *path == uri.path()) else {
        return (StatusCode::NOT_FOUND, "no such file\n").into_response();
    };
    let headers = [
        (CONTENT_TYPE, *kind),
        (CONTENT_SECURITY_POLICY, POLICY),
        (X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (CACHE_CONTROL, "no-cache"),
    ];
    (headers, *text).into_response()
}
