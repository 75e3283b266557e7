//! Limits a server's connections, in total and per client. If a limit is reached, a new connection replaces the
//! connection that has been idle longest, so that silent and slow clients cannot keep others out. If a client reaches
//! its limit, the client loses one of its connections.
//!
//! A connection is idle while the client has to act: to send a request, or to read the answer. A connection is never
//! closed while its request is being processed, or within [`GRACE`] of becoming idle. If such connections take all
//! slots, a new connection is rejected.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use tokio::task::AbortHandle;

/// Time in which a client may send its request or read its answer before another client may take the slot. A working
/// client needs far less.
pub(crate) const GRACE: Duration = Duration::from_millis(250);

/// Limits on simultaneous connections.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SlotLimits {
    /// Maximum number of connections of all clients together.
    pub total: usize,
    /// Maximum number of connections of one client.
    pub per_client: usize,
}

/// The slots; a client is identified by `K`.
#[derive(Debug)]
pub(crate) struct ConnectionSlots<K> {
    limits: SlotLimits,
    taken: Vec<Slot<K>>,
}

#[derive(Debug)]
struct Slot<K> {
    client: K,
    activity: Activity,
    task: AbortHandle,
}

/// Time at which the connection became idle; `None` = its request is being processed.
#[derive(Debug, Clone)]
pub struct Activity(Arc<Mutex<Option<Instant>>>);

impl Activity {
    /// The activity of a new connection, which is idle.
    pub(crate) fn new() -> Self {
        Self(Arc::new(Mutex::new(Some(Instant::now()))))
    }

    /// Records that a request has been received.
    pub(crate) fn begin_request(&self) {
        self.set(None);
    }

    /// Records that the answer is ready to be sent.
    pub(crate) fn end_request(&self) {
        self.set(Some(Instant::now()));
    }

    fn set(&self, idle_since: Option<Instant>) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = idle_since;
    }

    fn idle_since(&self) -> Option<Instant> {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<K: PartialEq> ConnectionSlots<K> {
    /// Creates slots without connections.
    pub(crate) fn new(limits: SlotLimits) -> Self {
        Self { limits, taken: Vec::new() }
    }

    /// Makes room for a connection of `client`. Returns `false` if this is not possible.
    pub(crate) fn make_room(&mut self, client: &K, now: Instant) -> bool {
        self.taken.retain(|place| !place.task.is_finished());
        let of_client = self.taken.iter().filter(|place| place.client == *client).count();
        if of_client >= self.limits.per_client {
            return self.close_idlest(now, |place| place.client == *client);
        }
        self.taken.len() < self.limits.total || self.close_idlest(now, |_| true)
    }

    /// Registers a connection after [`make_room`](Self::make_room).
    pub(crate) fn take(&mut self, client: K, activity: Activity, task: AbortHandle) {
        self.taken.push(Slot { client, activity, task });
    }

    fn close_idlest(&mut self, now: Instant, is_eligible: impl Fn(&Slot<K>) -> bool) -> bool {
        let idle = |place: &Slot<K>| place.activity.idle_since().filter(|since| now.duration_since(*since) >= GRACE);
        let places = self.taken.iter().enumerate().filter(|(_, place)| is_eligible(place));
        let idlest = places.filter_map(|(at, place)| Some((idle(place)?, at))).min();
        idlest.map(|(_, at)| self.taken.swap_remove(at).task.abort()).is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A connection that never ends on its own.
    fn connect(
        places: &mut ConnectionSlots<u32>,
        client: u32,
        now: Instant,
    ) -> Option<(Activity, tokio::task::JoinHandle<()>)> {
        if !places.make_room(&client, now) {
            return None;
        }
        let (activity, task) = (Activity::new(), tokio::spawn(std::future::pending()));
        places.take(client, activity.clone(), task.abort_handle());
        Some((activity, task))
    }

    #[tokio::test]
    async fn longest_idle_connection_is_closed_first() {
        let mut places = ConnectionSlots::new(SlotLimits { total: 3, per_client: 2 });
        let now = Instant::now();
        let (busy, mut busy_task) = connect(&mut places, 1, now).unwrap();
        busy.begin_request();
        let (_, first) = connect(&mut places, 2, now).unwrap();
        let (_, second) = connect(&mut places, 3, now).unwrap();
        assert!(connect(&mut places, 4, now).is_none(), "no connection has been idle for long enough");
        let later = Instant::now() + GRACE;
        let (fourth, _task) = connect(&mut places, 4, later).unwrap();
        assert!(first.await.unwrap_err().is_cancelled());
        let _fifth = connect(&mut places, 5, later).unwrap();
        assert!(second.await.unwrap_err().is_cancelled());
        fourth.begin_request();
        assert!(
            tokio::time::timeout(Duration::from_millis(20), &mut busy_task).await.is_err(),
            "its request is being processed"
        );
        busy_task.abort();
        assert!(busy_task.await.is_err());
        assert!(connect(&mut places, 6, now).is_some(), "one connection has ended");
    }

    #[tokio::test]
    async fn client_with_many_connections_loses_its_own() {
        let mut places = ConnectionSlots::new(SlotLimits { total: 3, per_client: 2 });
        let now = Instant::now();
        let (_other, mut other_task) = connect(&mut places, 1, now).unwrap();
        let (_, first) = connect(&mut places, 2, now).unwrap();
        let _second = connect(&mut places, 2, now).unwrap();
        let later = Instant::now() + GRACE;
        let _third = connect(&mut places, 2, later).unwrap();
        assert!(first.await.unwrap_err().is_cancelled());
        assert!(tokio::time::timeout(Duration::from_millis(20), &mut other_task).await.is_err());
    }
}
