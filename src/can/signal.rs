//! Signal layouts: where a number sits in a payload, and how to get it out and in.
