//! Who may look at the page.

use std::env::var_os;
use std::fs;
use std::io::{self, Write};
use std::net::SocketAddr;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use axum::extract::{Query, Request, State};
use axum::http::header::{COOKIE, HOST, ORIGIN, SET_COOKIE};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use tempfile::NamedTempFile;

/// What a request must show.
#[derive(Clone, Debug)]
pub(super) struct Access {
    address: SocketAddr,
    /// `None`: everybody on this computer may look.
    pub(super) token: Option<String>,
}

#[derive(Deserialize)]
pub(super) struct Given {
    token: Option<String>,
}

/// What a browser says of the page that a request comes from.
const FETCH_SITE: HeaderName = HeaderName::from_static("sec-fetch-site");
/// Keeps answers out of the pages of other sites.
const RESOURCE_POLICY: HeaderName = HeaderName::from_static("cross-origin-resource-policy");

impl Access {
    /// `is_lasting`: the token is the same when the program is started again, so that open pages find it.
    pub(super) fn of(address: SocketAddr, is_lasting: bool) -> Self {
        let token = (!address.ip().is_loopback()).then(|| {
            let new = format!("{:032x}", rand::random::<u128>());
            let Some(path) = token_file().filter(|_| is_lasting) else { return new };
            lasting_token(&path, &new).unwrap_or_else(|error| {
                tracing::warn!("{}: {error}; the page has a new token", path.display());
                new
            })
        });
        Self { address, token }
    }

    /// Whether a browser asks for itself and not for another site: a page of another site may send requests
    /// here, and a name of another site may lead to this address, but both show in these headers. Anybody may
    /// have a link to the page itself.
    fn is_own(&self, headers: &HeaderMap, path: &str) -> bool {
        let text = |name: &HeaderName| headers.get(name).and_then(|value| value.to_str().ok());
        let Some(host) = text(&HOST) else { return false };
        let own = self.address.to_string();
        // With a forwarded port, the header has another port. Browsers leave out port 80.
        let name = match host.rsplit_once(':') {
            Some((name, port)) if port.bytes().all(|byte| byte.is_ascii_digit()) => name,
            _ => host,
        };
        let is_here = self.token.is_some()
            || ["localhost", "127.0.0.1", "[::1]"].contains(&name)
            || [&*own, own.trim_end_matches(":80")].contains(&host);
        let is_same = text(&ORIGIN).is_none_or(|origin| origin == format!("http://{host}"));
        let from = text(&FETCH_SITE).unwrap_or("none");
        is_here && is_same && (path == "/" || ["none", "same-origin"].contains(&from))
    }

    /// The name of the cookie with the token; cookies are shared by all ports of a host.
    fn cookie(&self) -> String {
        format!("token-{}", self.address.port())
    }

    fn has_cookie(&self, token: &str, headers: &HeaderMap) -> bool {
        let name = self.cookie() + "=";
        let cookies = headers.get_all(COOKIE).iter().filter_map(|value| value.to_str().ok());
        let mut cookies = cookies.flat_map(|all| all.split(';')).map(str::trim);
        cookies.any(|one| one.strip_prefix(&name).is_some_and(|one| is_equal(one, token)))
    }
}

/// The file with the token of this user's live pages, by the XDG specification; `None`: the user has no home.
fn token_file() -> Option<PathBuf> {
    let folder = |variable| var_os(variable).map(PathBuf::from).filter(|path| path.is_absolute());
    let home = || Some(folder("HOME")?.join(".local/state"));
    Some(folder("XDG_STATE_HOME").or_else(home)?.join("bundlemocap/view-token"))
}

/// The token in a file that only this user can read. If there is no file, it is made with the new token.
///
/// # Errors
/// The file cannot be made or read, others can read it, or it holds something else.
fn lasting_token(path: &Path, new: &str) -> io::Result<String> {
    if !path.try_exists()? {
        let folder = path.parent().unwrap_or(path);
        fs::create_dir_all(folder)?;
        let mut file = NamedTempFile::new_in(folder)?;
        file.write_all(new.as_bytes())?;
        // If another node was faster, its token counts.
        let _ = file.persist_noclobber(path);
    }
    if fs::metadata(path)?.permissions().mode() & 0o077 != 0 {
        return Err(io::Error::other("others can read it; delete it"));
    }
    let text = fs::read_to_string(path)?;
    let token = text.trim();
    match token.len() == new.len() && token.bytes().all(|byte| byte.is_ascii_hexdigit()) {
        true => Ok(token.to_owned()),
        false => Err(io::Error::other("it holds no token; delete it")),
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
    if !access.is_own(headers, request.uri().path()) {
        return (StatusCode::FORBIDDEN, "requests of other sites are refused\n").into_response();
    }
    let mut cookie = None;
    if let Some(token) = &access.token {
        if given.token.is_some_and(|given| is_equal(&given, token)) {
            cookie = Some(format!("{}={token}; HttpOnly; SameSite=Strict", access.cookie()));
        } else if !access.has_cookie(token, headers) {
            let why = "open the address with its token, as the program printed it\n";
            return (StatusCode::UNAUTHORIZED, why).into_response();
        }
    }
    let mut response = next.run(request).await;
    let answer = response.headers_mut();
    answer.insert(RESOURCE_POLICY, HeaderValue::from_static("same-origin"));
    if let Some(cookie) = cookie.and_then(|cookie| HeaderValue::from_str(&cookie).ok()) {
        answer.insert(SET_COOKIE, cookie);
    }
    response
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_live_page_keeps_its_token() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("state/view-token");
        let [first, second] = ["0123456789abcdef", "fedcba9876543210"];
        assert_eq!(lasting_token(&path, first).unwrap(), first);
        assert_eq!(lasting_token(&path, second).unwrap(), first);
        fs::write(&path, format!("{second}\n")).unwrap();
        assert_eq!(lasting_token(&path, first).unwrap(), second);
        fs::set_permissions(&path, fs::Permissions::from_mode(0o644)).unwrap();
        assert!(lasting_token(&path, first).is_err());
        fs::set_permissions(&path, fs::Permissions::from_mode(0o600)).unwrap();
        fs::write(&path, "cut").unwrap();
        assert!(lasting_token(&path, first).is_err());
        assert!(lasting_token(&path.join("below a file"), first).is_err());
    }
}
