//! Limits a server's connections: in total, per user and per client. Some slots are reserved for root. If all slots
//! are taken, a new connection replaces the connection that has been idle longest, so that silent and slow clients
//! cannot keep others out. If a client or a user reaches its own limit, it loses one of its own connections.
//!
//! A connection is idle while the client has to act: to send a request, or to read the answer. A connection is never
//! closed while its request is being processed, or within [`GRACE`] of becoming idle. If such connections take all
//! slots, a new connection is rejected.

use std::net::IpAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use tokio::net::unix::UCred;
use tokio::task::AbortHandle;

/// Time in which a client may send its request or read its answer before another client may take the slot. A working
/// client needs far less.
pub(crate) const GRACE: Duration = Duration::from_millis(250);

#[derive(Debug, Clone, Copy)]
pub(crate) struct SlotLimits {
    pub total: usize,
    /// Slots of `total` that only root may take.
    pub for_root: usize,
    pub per_user: usize,
    pub per_client: usize,
}

pub(crate) trait Client: PartialEq {
    /// The number of the user, if the kernel reports it.
    fn user(&self) -> Option<u32> {
        None
    }
}

/// A TCP client is identified by its address.
impl Client for IpAddr {}

/// A client of a Unix socket is identified by user and process. Processes that the kernel does not identify count as
/// one process.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct LocalProcess {
    user: u32,
    process: Option<i32>,
}

impl From<&UCred> for LocalProcess {
    fn from(peer: &UCred) -> Self {
        Self { user: peer.uid(), process: peer.pid() }
    }
}

impl Client for LocalProcess {
    fn user(&self) -> Option<u32> {
        Some(self.user)
    }
}

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

impl<K: Client> ConnectionSlots<K> {
    pub(crate) fn new(limits: SlotLimits) -> Self {
        Self { limits, taken: Vec::new() }
    }

    /// Makes room for a connection of `client`. Returns `false` if this is not possible.
    pub(crate) fn make_room(&mut self, client: &K, now: Instant) -> bool {
        self.taken.retain(|place| !place.task.is_finished());
        let SlotLimits { total, for_root, per_user, per_client } = self.limits;
        let user = client.user();
        let count = |is_counted: &dyn Fn(&Slot<K>) -> bool| self.taken.iter().filter(|place| is_counted(place)).count();
        if count(&|place| place.client == *client) >= per_client {
            return self.close_idlest(now, |place| place.client == *client);
        }
        if user.is_some() && count(&|place| place.client.user() == user) >= per_user {
            return self.close_idlest(now, |place| place.client.user() == user);
        }
        let free_to = if user == Some(0) { total } else { total - for_root };
        // Only root may replace connections of root.
        let is_root = |of: Option<u32>| of == Some(0);
        self.taken.len() < free_to || self.close_idlest(now, |place| is_root(user) || !is_root(place.client.user()))
    }

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

    impl Client for u32 {}

    const LIMITS: SlotLimits = SlotLimits { total: 3, for_root: 0, per_user: 3, per_client: 2 };

    /// A connection that never ends on its own.
    fn connect<K: Client>(
        places: &mut ConnectionSlots<K>,
        client: K,
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
        let mut places = ConnectionSlots::new(LIMITS);
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
        let mut places = ConnectionSlots::new(LIMITS);
        let now = Instant::now();
        let (_other, mut other_task) = connect(&mut places, 1, now).unwrap();
        let (_, first) = connect(&mut places, 2, now).unwrap();
        let _second = connect(&mut places, 2, now).unwrap();
        let later = Instant::now() + GRACE;
        let _third = connect(&mut places, 2, later).unwrap();
        assert!(first.await.unwrap_err().is_cancelled());
        assert!(tokio::time::timeout(Duration::from_millis(20), &mut other_task).await.is_err());
    }

    #[tokio::test]
    async fn one_user_leaves_slots_for_others_and_root() {
        let limits = SlotLimits { total: 8, for_root: 1, per_user: 5, per_client: 2 };
        let mut places = ConnectionSlots::new(limits);
        let now = Instant::now();
        let of = |user, process| LocalProcess { user, process: Some(process) };
        let mut open = Vec::new();
        let mut try_each = |user, processes: std::ops::Range<i32>| {
            let new: Vec<_> = processes.filter_map(|process| connect(&mut places, of(user, process), now)).collect();
            let count = new.len();
            open.extend(new);
            count
        };
        assert_eq!(try_each(1000, 0..20), 5, "one user, one connection per process");
        assert_eq!(try_each(1001, 20..40), 2, "another user, up to the slot for root");
        assert_eq!(try_each(0, 40..60), 1);
        let of_root = places.taken.last().expect("root's").task.clone();
        for _ in 0..8 {
            places.make_room(&of(1002, 99), now + 2 * GRACE);
        }
        tokio::task::yield_now().await;
        assert!(!of_root.is_finished(), "a user does not replace root");
        drop(open.split_off(5));
        let mut places = ConnectionSlots::new(limits);
        let of_root: Vec<_> = (0..9).filter_map(|_| connect(&mut places, of(0, 1), now)).collect();
        assert_eq!(of_root.len(), 2, "one process of root");
    }
}
