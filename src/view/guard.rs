//! Access control: checks on every request before it is processed.

use std::fmt::Write;
use std::net::{IpAddr, SocketAddr};

use axum::http::header::{HOST, HeaderName, ORIGIN};
use axum::http::{HeaderMap, StatusCode};

use crate::{Error, Result};

/// Length of a token, bytes.
const TOKEN_BYTES: usize = 16;

/// The host names, origins and token that a request must match.
pub struct Guard {
    address: SocketAddr,
    token: Option<String>,
}

impl Guard {
    /// The guard of a server on an address. A server that other machines can reach gets a random token.
    ///
    /// # Errors
    /// The system has no random number source.
    pub fn new(address: SocketAddr) -> Result<Guard> {
        let token = match address.ip().is_loopback() {
            true => None,
            false => Some(token()?),
        };
        Ok(Guard { address, token })
    }

    /// Path prefix of the page on this server.
    pub fn base(&self) -> String {
        self.token.as_ref().map_or("/".into(), |token| format!("/{token}/"))
    }

    /// URL of the page, as reachable from this machine.
    pub fn url(&self) -> String {
        let mut address = self.address;
        if address.ip().is_unspecified() {
            address.set_ip(match address.ip() {
                IpAddr::V4(_) => IpAddr::from([127, 0, 0, 1]),
                IpAddr::V6(_) => IpAddr::from([0, 0, 0, 0, 0, 0, 0, 1]),
            });
        }
        format!("http://{address}{}", self.base())
    }

    /// The part of a request's path behind the base.
    ///
    /// # Errors
    /// The status and message of a rejected request.
    pub fn admit<'a>(
        &self,
        path: &'a str,
        headers: &HeaderMap,
    ) -> std::result::Result<&'a str, (StatusCode, &'static str)> {
        let host = one(headers, &HOST).ok_or((StatusCode::BAD_REQUEST, "one Host is expected"))?;
        if !self.is_own(host) {
            // A request from a page whose name was rebound to this machine.
            return Err((StatusCode::FORBIDDEN, "this server does not go by that name"));
        }
        if headers.contains_key(ORIGIN) {
            let origin = one(headers, &ORIGIN).and_then(|origin| origin.strip_prefix("http://"));
            if origin != Some(host) {
                return Err((StatusCode::FORBIDDEN, "pages of other servers are not served"));
            }
        }
        let path = path.strip_prefix('/').unwrap_or(path);
        let Some(token) = &self.token else { return Ok(path) };
        let (given, rest) = path.split_once('/').unwrap_or((path, ""));
        match is_same(given, token) {
            true => Ok(rest),
            false => Err((
                StatusCode::FORBIDDEN,
                "the address lacks its token; use the one that `splat4d view` printed",
            )),
        }
    }

    /// Whether a `Host` is a name of this server: its address, or `localhost` on a loopback address; for a
    /// server that listens on all addresses, any numeric address. Names are not resolved, because DNS
    /// rebinding exploits that.
    fn is_own(&self, host: &str) -> bool {
        let port = self.address.port();
        let own = self.address.ip();
        if let Ok(named) = host.parse::<SocketAddr>() {
            let both_loopback = own.is_loopback() && named.ip().is_loopback();
            let fits = named.ip() == own || own.is_unspecified() || both_loopback;
            return fits && named.port() == port;
        }
        if port == 80 && host.trim_matches(['[', ']']).parse::<IpAddr>().is_ok_and(|ip| ip == own) {
            return true;
        }
        let reached_as_localhost = own.is_loopback() || own.is_unspecified();
        reached_as_localhost
            && host.rsplit_once(':').is_some_and(|(name, number)| {
                name.eq_ignore_ascii_case("localhost") && number.parse() == Ok(port)
            })
    }
}

/// The value of a header that occurs exactly once.
fn one<'a>(headers: &'a HeaderMap, name: &HeaderName) -> Option<&'a str> {
    let mut all = headers.get_all(name).iter();
    let first = all.next()?.to_str().ok()?;
    all.next().is_none().then_some(first)
}

/// Constant-time comparison of two strings.
fn is_same(given: &str, token: &str) -> bool {
    let differing = given.bytes().zip(token.bytes()).fold(0, |sum, (a, b)| sum | (a ^ b));
    given.len() == token.len() && differing == 0
}

fn token() -> Result<String> {
    let mut bytes = [0; TOKEN_BYTES];
    getrandom::fill(&mut bytes)
        .map_err(|error| Error::Failed(format!("the system gives no random token: {error}")))?;
    let mut text = String::new();
    bytes.iter().for_each(|byte| write!(text, "{byte:02x}").expect("a String takes it"));
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn headers(pairs: &[(HeaderName, &'static str)]) -> HeaderMap {
        pairs.iter().map(|(name, value)| (name.clone(), value.parse().unwrap())).collect()
    }

    #[test]
    fn only_own_names_and_own_pages_are_admitted() {
        let guard = Guard::new("127.0.0.1:8090".parse().unwrap()).unwrap();
        assert_eq!((guard.base().as_str(), guard.url().as_str()), ("/", "http://127.0.0.1:8090/"));
        for host in ["127.0.0.1:8090", "localhost:8090", "LOCALHOST:8090", "[::1]:8090"] {
            let map = headers(&[(HOST, host)]);
            assert_eq!(guard.admit("/a/b", &map), Ok("a/b"), "{host}");
        }
        for host in [
            "127.0.0.1",
            "127.0.0.1:80",
            "evil.example:8090",
            "localhost.evil.example:8090",
            "10.0.0.1:8090",
            "",
            ":8090",
            "localhost",
        ] {
            assert!(guard.admit("/", &headers(&[(HOST, host)])).is_err(), "{host}");
        }
        assert!(guard.admit("/", &HeaderMap::new()).is_err());
        let with = |origin| headers(&[(HOST, "localhost:8090"), (ORIGIN, origin)]);
        assert!(guard.admit("/", &with("http://localhost:8090")).is_ok());
        for origin in
            ["http://127.0.0.1:8090", "https://localhost:8090", "null", "http://localhost:8091"]
        {
            assert!(guard.admit("/", &with(origin)).is_err(), "{origin}");
        }
        let mut twice = headers(&[(HOST, "localhost:8090")]);
        twice.append(HOST, "evil.example:8090".parse().unwrap());
        assert!(guard.admit("/", &twice).is_err());
    }

    #[test]
    fn an_address_that_others_reach_has_a_token() {
        let guard = Guard::new("0.0.0.0:8090".parse().unwrap()).unwrap();
        let other = Guard::new("0.0.0.0:8090".parse().unwrap()).unwrap();
        let base = guard.base();
        assert!(base.len() == 2 + 2 * TOKEN_BYTES && base != other.base(), "{base}");
        assert_eq!(guard.url(), format!("http://127.0.0.1:8090{base}"));
        let map = headers(&[(HOST, "10.1.2.3:8090")]);
        assert_eq!(guard.admit(&format!("{base}ws"), &map), Ok("ws"));
        assert_eq!(guard.admit(base.trim_end_matches('/'), &map), Ok(""));
        for path in ["/", "/ws", &other.base(), &base[..9], &format!("/x{base}")] {
            assert!(guard.admit(path, &map).is_err(), "{path}");
        }
        assert!(guard.admit(&base, &headers(&[(HOST, "evil.example:8090")])).is_err());
    }
}
