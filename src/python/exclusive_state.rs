//! Gives one call at a time access to a monitor's state, from any thread.
//!
//! A call that waits does not hold the interpreter's lock. If a signal handler raises an exception, as for Ctrl-C, the
//! wait ends. Two kinds of calls fail immediately. The first is a call from a signal handler, if the handler has
//! interrupted another call on the same thread. The second is any call after an earlier call panicked, because the
//! state may then be inconsistent.

use std::ops::{Deref, DerefMut};
use std::sync::{Mutex, MutexGuard, PoisonError, TryLockError};
use std::thread::{self, ThreadId};
use std::time::Duration;

use pyo3::prelude::*;

use crate::error::data;

/// A monitor's state. Only one call at a time may use it.
pub(crate) struct ExclusiveState<S> {
    state: Mutex<S>,
    /// Thread of the running call.
    holder: Mutex<Option<ThreadId>>,
}

pub(crate) struct StateGuard<'a, S> {
    state: MutexGuard<'a, S>,
    owner: &'a ExclusiveState<S>,
}

impl<S> ExclusiveState<S> {
    pub(crate) fn new(state: S) -> Self {
        Self { state: Mutex::new(state), holder: Mutex::new(None) }
    }

    /// Waits for exclusive access.
    ///
    /// # Errors
    /// Fails if an earlier call panicked, if a call is already running on this thread, or if a signal handler raises an
    /// exception.
    pub(crate) fn wait(&self, py: Python<'_>) -> PyResult<StateGuard<'_, S>> {
        loop {
            match self.state.try_lock() {
                Ok(state) => {
                    self.set_holder(Some(thread::current().id()));
                    return Ok(StateGuard { state, owner: self });
                }
                Err(TryLockError::Poisoned(_)) => {
                    return Err(data("an earlier call failed inside packwatch; create a new Monitor"));
                }
                Err(TryLockError::WouldBlock) if self.holder() == Some(thread::current().id()) => {
                    return Err(data("the Monitor is in use by the call that this signal handler interrupts"));
                }
                Err(TryLockError::WouldBlock) => {
                    py.check_signals()?;
                    // This polling interval is too short for a user to notice, and much longer than one check takes.
                    py.detach(|| thread::sleep(Duration::from_millis(1)));
                }
            }
        }
    }

    fn holder(&self) -> Option<ThreadId> {
        *self.holder.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn set_holder(&self, thread: Option<ThreadId>) {
        *self.holder.lock().unwrap_or_else(PoisonError::into_inner) = thread;
    }
}

impl<S> Deref for StateGuard<'_, S> {
    type Target = S;

    fn deref(&self) -> &S {
        &self.state
    }
}

impl<S> DerefMut for StateGuard<'_, S> {
    fn deref_mut(&mut self) -> &mut S {
        &mut self.state
    }
}

impl<S> Drop for StateGuard<'_, S> {
    fn drop(&mut self) {
        // The holder is cleared before the state is released, because the next call sets its own thread.
        self.owner.set_holder(None);
    }
}
