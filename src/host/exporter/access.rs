//! Decides who may read: every local user, or clients that know the token.
//!
//! | address | no token is configured | a token is configured |
//! | --- | --- | --- |
//! | loopback | everything | everything, if the client sends the token |
//! | any other | metrics only | everything, if the client sends the token |
//!
//! A client sends the token as `Authorization: Bearer TOKEN`, or once as `?token=TOKEN`. In the second case the answer
//! sets a cookie and redirects to the address without the token, so that the token does not stay in the browser's
//! history. The liveness check needs no token.
//!
//! If no token is configured, the requests for anything but metrics must name this computer ([`names_this_computer`]).

use std::fs;
use std::hint::black_box;
use std::net::IpAddr;
use std::path::Path;

use hyper::Request;
use hyper::header::{AUTHORIZATION, COOKIE};

use crate::http::names_this_computer;

/// Fewest characters of a token. 16 hexadecimal digits are 64 bits.
const MIN_TOKEN: usize = 16;
/// Most characters of a token.
const MAX_TOKEN: usize = 128;
const COOKIE_NAME: &str = "packwatch_token";

pub(super) struct Access {
    token: Option<String>,
    is_local: bool,
}

#[derive(Debug, PartialEq, Eq)]
pub(super) enum Decision {
    Allowed,
    /// The query contains the token: set this cookie and redirect to the address without the query.
    SetCookie(String),
    NeedsToken,
    /// Served only on an address of this computer, or with a token.
    OnlyLocal,
}

impl Access {
    /// Reads the token, if there is one. `address` is the address on which the exporter listens.
    ///
    /// # Errors
    /// Fails if the file cannot be read, or if it does not contain a token.
    pub(super) fn new(address: IpAddr, file: Option<&Path>) -> Result<Self, String> {
        let token = file.map(read_token).transpose()?;
        Ok(Self { token, is_local: address.to_canonical().is_loopback() })
    }

    /// Whether the page is served. On a network address, it is served only if a token is configured.
    pub(super) fn has_page(&self) -> bool {
        self.is_local || self.token.is_some()
    }

    pub(super) fn decide<B>(&self, request: &Request<B>) -> Decision {
        let path = request.uri().path();
        let header = |name| request.headers().get_all(name).iter().filter_map(|value| value.to_str().ok());
        let Some(token) = self.token.as_deref().filter(|_| path != "/-/healthy") else {
            let is_local = self.is_local && names_this_computer(request);
            let is_open = is_local || matches!(path, "/metrics" | "/-/healthy");
            return if is_open { Decision::Allowed } else { Decision::OnlyLocal };
        };
        let query = request.uri().query().unwrap_or_default();
        if query.split('&').filter_map(|pair| pair.strip_prefix("token=")).any(|given| is_equal(given, token)) {
            return Decision::SetCookie(format!(
                "{COOKIE_NAME}={token}; Path=/; Max-Age=31536000; HttpOnly; SameSite=Lax"
            ));
        }
        let bearer = header(AUTHORIZATION).filter_map(|value| value.split_once(' '));
        let mut bearer = bearer.filter(|(scheme, _)| scheme.eq_ignore_ascii_case("bearer")).map(|(_, given)| given);
        let cookies = header(COOKIE).flat_map(|value| value.split(';').filter_map(|pair| pair.trim().split_once('=')));
        let mut cookies = cookies.filter(|(name, _)| *name == COOKIE_NAME).map(|(_, given)| given);
        let is_known = bearer.any(|given| is_equal(given, token)) || cookies.any(|given| is_equal(given, token));
        if is_known { Decision::Allowed } else { Decision::NeedsToken }
    }
}

/// Compares in a time that does not depend on the position of the first difference.
fn is_equal(given: &str, token: &str) -> bool {
    let differences = given.bytes().zip(token.bytes()).fold(0, |all, (one, other)| black_box(all | (one ^ other)));
    given.len() == token.len() && differences == 0
}

fn read_token(file: &Path) -> Result<String, String> {
    let text = fs::read_to_string(file).map_err(|error| format!("{}: cannot be read: {error}", file.display()))?;
    let token = text.trim_end();
    let is_plain = token.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"-._~".contains(&byte));
    if is_plain && (MIN_TOKEN..=MAX_TOKEN).contains(&token.len()) {
        return Ok(token.to_owned());
    }
    Err(format!(
        "{}: token of {} characters, must be {MIN_TOKEN} to {MAX_TOKEN} letters, digits, '-', '.', '_' or '~'; for example: \
         openssl rand -hex 16",
        file.display(),
        token.chars().count()
    ))
}
