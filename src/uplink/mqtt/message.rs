//! A message to the broker.

/// A message to the broker.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Message {
    /// Its topic.
    pub topic: String,
    /// Its text. If empty and retained, the broker removes the retained message.
    pub text: String,
    /// Whether the broker keeps it for later readers.
    pub is_retained: bool,
}

impl Message {
    /// Creates a message that the broker keeps.
    pub fn retained(topic: String, text: impl Into<String>) -> Self {
        Self { topic, text: text.into(), is_retained: true }
    }
}
