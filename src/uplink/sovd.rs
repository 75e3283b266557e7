//! `sovd`: serves the faults and the values of the battery as one component, in the style of ASAM SOVD 1.0 (ISO 17978-3).
//!
//! Input: settings, and status documents of the daemon. Output: JSON over HTTP/1.1 on a loopback address. The server is
//! read-only. It has no authorization, locks, operations, modes or updates. While the daemon is silent, values and
//! faults give an error, never an old value.
//!
//! | module | content |
//! | --- | --- |
//! | `resources` | converts path and document to JSON or an error |
//! | `settings` | the table `[sovd]` |

mod resources;
pub mod settings;

use std::rc::Rc;

use packwatch_host::http::{
    self, Bytes, Full, Response, StatusCode, answer_with, header, names_this_computer, reads, with,
};
use packwatch_host::io::runtime::new_runtime;
use packwatch_host::io::stop::Stop;
use packwatch_host::status::document::StatusDocument;
use serde_json::Value;
use tokio::net::TcpListener;
use tokio::task::LocalSet;

use crate::status_stream::follow;
use crate::{Failure, Options};
use resources::Fault;

/// Runs until a signal of [`Stop`].
///
/// # Errors
/// Fails if the settings are invalid, or if the address cannot be bound.
pub fn run(options: &Options) -> Result<(), Failure> {
    let settings = options.start()?;
    let listen = settings.sovd.listen;
    let runtime = new_runtime().map_err(|error| Failure::new(format!("cannot start: {error}")))?;
    let served = LocalSet::new().block_on(&runtime, async {
        let mut stop = Stop::new(None)?;
        let listener = TcpListener::bind(listen).await?;
        tracing::info!(address = %listener.local_addr()?, "SOVD server listening");
        let documents = Rc::new(follow(&settings.status.socket));
        let answer = move |request, _, _| {
            let documents = Rc::clone(&documents);
            async move { answer(&request, documents.borrow().as_deref()) }
        };
        http::serve(listener, &mut stop, answer).await;
        Ok::<_, std::io::Error>(())
    });
    served.map_err(|error| {
        Failure::new(format!("sovd.listen = \"{listen}\": {error}; give a free port of this computer"))
    })
}

fn answer<B>(request: &http::Request<B>, document: Option<&StatusDocument>) -> Response<Full<Bytes>> {
    let reply = match () {
        () if !reads(request) => Err(Fault::read_only()),
        () if !names_this_computer(request) => Err(Fault::foreign_host()),
        () => resources::get(request.uri().path(), request.uri().query().unwrap_or_default(), document),
    };
    let (status, body) = reply.map_or_else(|fault| (fault.status, fault.body()), |body| (StatusCode::OK, body));
    let answer = answer_with(status, "application/json", text(&body));
    if status == StatusCode::METHOD_NOT_ALLOWED { with(answer, header::ALLOW, "GET, HEAD") } else { answer }
}

fn text(body: &Value) -> Full<Bytes> {
    Full::new(format!("{body}\n").into())
}

#[cfg(test)]
mod tests;
