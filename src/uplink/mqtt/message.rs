//! Defines a message to the broker.

/// A message to the broker.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Message {
    /// Topic of the message.
    pub topic: String,
    /// Text of the message. If it is empty and the message is retained, the broker deletes its retained message of this
    /// topic.
    pub text: String,
    /// Whether the broker keeps the message for later readers.
    pub is_retained: bool,
}

impl Message {
    /// Creates a message that the broker keeps.
    pub fn retained(topic: String, text: impl Into<String>) -> Self {
        Self { topic, text: text.into(), is_retained: true }
    }
}
