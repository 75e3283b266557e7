//! A monitor's state for one call at a time, whatever threads they come from.
//!
//! A call that waits for its turn holds no lock of the interpreter, and a signal ends the wait. Two calls fail instead of waiting: one
//! that a signal handler makes while its own thread is in another, and any after a panic, which left the state half changed.

use std::ops::{Deref, DerefMut};
use std::sync::{Mutex, MutexGuard, PoisonError, TryLockError};
use std::thread::{self, ThreadId};
use std::time::Duration;

use pyo3::prelude::*;

use crate::error::data;
use crate::monitor::State;

/// A monitor's state, for one call at a time.
pub(crate) struct ExclusiveState {
    state: Mutex<State>,
    /// Thread of the call whose turn it is.
    holder: Mutex<Option<ThreadId>>,
}

/// The turn of one call.
pub(crate) struct StateGuard<'a> {
    state: MutexGuard<'a, State>,
    owner: &'a ExclusiveState,
}

impl ExclusiveState {
    pub(crate) fn new(state: State) -> Self {
        Self { state: Mutex::new(state), holder: Mutex::new(None) }
    }

    /// Waits for the turn of this call.
    ///
    /// # Errors
    /// An earlier call has failed inside the library, this thread is in another call, or a signal handler raises an exception.
    pub(crate) fn wait(&self, py: Python<'_>) -> PyResult<StateGuard<'_>> {
        loop {
            match self.state.try_lock() {
                Ok(state) => {
                    self.set_holder(Some(thread::current().id()));
                    return Ok(StateGuard { state, owner: self });
                }
                Err(TryLockError::Poisoned(_)) => {
                    return Err(data("an earlier call failed inside packwatch: make a new Monitor"));
                }
                Err(TryLockError::WouldBlock) if self.holder() == Some(thread::current().id()) => {
                    return Err(data("the Monitor is at work in the call that this one interrupts"));
                }
                Err(TryLockError::WouldBlock) => {
                    py.check_signals()?;
                    // Between two looks at whether it is this call's turn: short beside a call's own overhead in Python, long beside a look.
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

impl Deref for StateGuard<'_> {
    type Target = State;

    fn deref(&self) -> &State {
        &self.state
    }
}

impl DerefMut for StateGuard<'_> {
    fn deref_mut(&mut self) -> &mut State {
        &mut self.state
    }
}

impl Drop for StateGuard<'_> {
    fn drop(&mut self) {
        // Before the state is free: the next holder sets its own.
        self.owner.set_holder(None);
    }
}
