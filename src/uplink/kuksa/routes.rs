//! Maps the broker's ids to signals, for one connection.
//!
//! Input: the broker's metadata and status documents. Output: the claim (the request to be the provider of these
//! signals), and data points by id. A signal has a route only if the broker lists its path with the same datatype and a
//! unique id. Ids change when the broker restarts, so the routes belong to one connection. A value outside the broker's
//! limits is withheld: its data point is sent without a value.

use std::collections::{BTreeMap, HashMap};

use packwatch_host::io::clock::Reading;
use packwatch_host::quantity::Timestamp as StatusTime;
use packwatch_host::status::document::StatusDocument;

use super::messages::{Datapoint, Metadata, ProvideSignalRequest, SampleInterval, Timestamp, Value};
use super::signals::{self, Signal};
use super::value::{Limits, limit, type_name};

#[derive(Debug)]
struct Route {
    signal: &'static Signal,
    limits: Limits,
}

/// A signal that this connection does not provide, and the reason.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct SkippedSignal {
    pub(crate) path: String,
    pub(crate) reason: String,
}

/// Data points for the broker.
#[derive(Debug, Default)]
pub(crate) struct DataPoints {
    pub(crate) by_id: BTreeMap<i32, Datapoint>,
    /// Signals whose values are outside the broker's limits.
    pub(crate) withheld: Vec<&'static str>,
}

#[derive(Debug)]
pub(crate) struct Routes {
    by_id: BTreeMap<i32, Route>,
}

impl Routes {
    /// Searches the broker's metadata for every signal. packwatch's own signals, which extend the standard VSS tree
    /// (the overlay), are below `branch`. `is_from_new` states whether packwatch has watched the battery since it was
    /// new, so that sums over its life are known.
    pub(crate) fn resolve(metadata: &[Metadata], branch: &str, is_from_new: bool) -> (Self, Vec<SkippedSignal>) {
        let mut uses: HashMap<i32, usize> = HashMap::new();
        let mut by_path: HashMap<&str, &Metadata> = HashMap::new();
        for entry in metadata {
            // If the standard branch is below the overlay's branch, the standard signals are listed twice.
            if by_path.insert(&entry.path, entry).is_none_or(|earlier| earlier.id != entry.id) {
                *uses.entry(entry.id).or_default() += 1;
            }
        }
        let (mut by_id, mut skipped) = (BTreeMap::new(), Vec::new());
        for signal in signals::all().filter(|signal| is_from_new || !signal.is_lifetime()) {
            let path = signal.path(branch);
            let found = by_path.get(path.as_str()).copied();
            match found
                .ok_or_else(|| "the broker does not know the signal".to_owned())
                .and_then(|entry| check(signal, entry, &uses))
            {
                Ok((id, route)) => drop(by_id.insert(id, route)),
                Err(reason) => skipped.push(SkippedSignal { path, reason }),
            }
        }
        (Self { by_id }, skipped)
    }

    pub(crate) fn len(&self) -> usize {
        self.by_id.len()
    }

    /// Name of the signal with this id; `None` = this connection does not provide such a signal.
    pub(crate) fn name(&self, id: i32) -> Option<&'static str> {
        self.by_id.get(&id).map(|route| &*route.signal.name)
    }

    /// Claims every signal.
    pub(crate) fn claim(&self) -> ProvideSignalRequest {
        // The daemon reports once a second.
        let interval = SampleInterval { interval_ms: 1000 };
        ProvideSignalRequest { signals: self.by_id.keys().map(|id| (*id, interval)).collect() }
    }

    /// Returns a data point for every signal. Without a document, all values are unknown.
    pub(crate) fn points(&self, document: Option<&StatusDocument>) -> DataPoints {
        self.points_of(self.by_id.keys(), document)
    }

    /// Returns a data point for each of these ids that this connection provides.
    pub(crate) fn points_of<'a>(
        &self,
        ids: impl IntoIterator<Item = &'a i32>,
        document: Option<&StatusDocument>,
    ) -> DataPoints {
        let timestamp = Some(document.map_or_else(now, |document| timestamp(document.wall_time)));
        let mut points = DataPoints::default();
        for (id, route) in ids.into_iter().filter_map(|id| self.by_id.get_key_value(id)) {
            let value = document
                .and_then(|document| route.signal.value(document))
                .filter(|value| value.data_type() == route.signal.data_type);
            let is_withheld = value.as_ref().is_some_and(|value| !value.is_within(route.limits));
            if is_withheld {
                points.withheld.push(&route.signal.name);
            }
            let value = value.filter(|_| !is_withheld).map(|value| Value { typed: Some(value.into_message()) });
            points.by_id.insert(*id, Datapoint { timestamp, value });
        }
        points
    }
}

/// Checks the broker's entry for a signal and returns its id and route.
fn check(signal: &'static Signal, entry: &Metadata, uses: &HashMap<i32, usize>) -> Result<(i32, Route), String> {
    if entry.data_type != signal.data_type.code() {
        let (found, expected) = (type_name(entry.data_type), signal.data_type.name());
        return Err(format!("datatype {found} in the broker, must be {expected}"));
    }
    if uses.get(&entry.id).is_some_and(|uses| *uses > 1) {
        return Err(format!("the broker uses id {} for another signal too", entry.id));
    }
    if entry.allowed.as_ref().is_some_and(|allowed| allowed.typed.is_some()) {
        return Err(
            "the broker allows listed values only; it would keep the last value if the value became unknown".to_owned()
        );
    }
    let limits = Limits { min: limit(entry.min.as_ref()), max: limit(entry.max.as_ref()) };
    Ok((entry.id, Route { signal, limits }))
}

fn timestamp(time: StatusTime) -> Timestamp {
    let nanos = time.nanos();
    let rest = i32::try_from(nanos.rem_euclid(1_000_000_000)).unwrap_or_default();
    Timestamp { seconds: nanos.div_euclid(1_000_000_000), nanos: rest }
}

fn now() -> Timestamp {
    timestamp(StatusTime::from_nanos(Reading::now().realtime_ns))
}

#[cfg(test)]
#[path = "routes/tests.rs"]
mod tests;
