//! Who may look at the page.

use std::net::SocketAddr;

use axum::extract::{Query, Request, State};
use axum::http::header::{COOKIE, HOST, ORIGIN, SET_COOKIE};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use serde::Deserialize;

/// What a request must show.
#[derive(Clone, Debug)]
pub(super) struct Access {
    port: u16,
    /// `None`: everybody on this computer may look.
    pub(super) token: Option<String>,
}

#[derive(Deserialize)]
pub(super) struct Given {
    token: Option<String>,
}

impl Access {
    pub(super) fn of(address: SocketAddr) -> Self {
        let token =
            (!address.ip().is_loopback()).then(|| format!("{:032x}", rand::random::<u128>()));
        Self { port: address.port(), token }
    }

    /// Whether a browser asks for itself and not for another site: a page of another site may send requests
    /// here, and a name of another site may lead to this address, but both show in these headers.
    fn is_own(&self, headers: &HeaderMap) -> bool {
        let text = |name: HeaderName| headers.get(name).and_then(|value| value.to_str().ok());
        let Some(host) = text(HOST) else { return false };
        let names = ["localhost", "127.0.0.1", "[::1]"];
        let is_local = names.iter().any(|name| host == format!("{name}:{}", self.port));
        let is_same = text(ORIGIN).is_none_or(|origin| origin == format!("http://{host}"));
        (is_local || self.token.is_some()) && is_same
    }

    fn is_known(&self, given: &Given, headers: &HeaderMap) -> bool {
        let Some(token) = &self.token else { return true };
        let cookies = headers.get_all(COOKIE).iter().filter_map(|value| value.to_str().ok());
        let mut cookies = cookies.flat_map(|all| all.split(';')).map(str::trim);
        given.token.as_deref().is_some_and(|given| is_equal(given, token))
            || cookies.any(|one| one.strip_prefix("token=").is_some_and(|one| is_equal(one, token)))
    }
}

/// Takes the same time wherever the texts differ.
fn is_equal(a: &str, b: &str) -> bool {
    a.len() == b.len() && a.bytes().zip(b.bytes()).fold(0, |all, (a, b)| all | (a ^ b)) == 0
}

/// Refuses requests of other sites and those without the token. A token in the address becomes a cookie.
pub(super) async fn check(
    State(access): State<Access>,
    Query(given): Query<Given>,
    request: Request,
    next: Next,
) -> Response {
    let headers = request.headers();
    if !access.is_own(headers) {
        return (StatusCode::FORBIDDEN, "requests of other sites are refused\n").into_response();
    }
    if !access.is_known(&given, headers) {
        let why = "open the address with its token, as the program printed it\n";
        return (StatusCode::UNAUTHORIZED, why).into_response();
    }
    let mut response = next.run(request).await;
    if let Some(token) = given.token
        && let Ok(cookie) =
            HeaderValue::from_str(&format!("token={token}; HttpOnly; SameSite=Strict"))
    {
        response.headers_mut().insert(SET_COOKIE, cookie);
    }
    response
}
