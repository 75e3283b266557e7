//! Defines the messages and the two calls of the protocol `kuksa.val.v2` that a provider of values needs.
//!
//! The messages are written by hand, because the generated client of the KUKSA project compiles protoc, a C++ program,
//! at every build. Fields that this program does not read are omitted, because protobuf skips unknown fields. The field
//! numbers are the same as in the published protocol.

use std::collections::BTreeMap;

use tokio_stream::Stream;
use tonic::client::Grpc;
use tonic::codegen::http::uri::PathAndQuery;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::transport::Channel;
use tonic::{IntoStreamingRequest, Request, Status, Streaming};
use tonic_prost::ProstCodec;

/// A time stamp: seconds since 1970 and nanoseconds.
#[derive(Clone, Copy, PartialEq, Eq, prost::Message)]
pub(crate) struct Timestamp {
    #[prost(int64, tag = "1")]
    pub(crate) seconds: i64,
    #[prost(int32, tag = "2")]
    pub(crate) nanos: i32,
}

/// A value with its time; without `value`, the value is unknown.
#[derive(Clone, PartialEq, prost::Message)]
pub(crate) struct Datapoint {
    #[prost(message, optional, tag = "1")]
    pub(crate) timestamp: Option<Timestamp>,
    #[prost(message, optional, tag = "2")]
    pub(crate) value: Option<Value>,
}

/// A value; if `typed` is `None`, the value is unknown.
#[derive(Clone, PartialEq, prost::Message)]
pub(crate) struct Value {
    #[prost(oneof = "TypedValue", tags = "11, 12, 13, 14, 15, 16, 17, 18, 21, 22, 25, 27")]
    pub(crate) typed: Option<TypedValue>,
}

/// Types of the values that this program publishes, or reads as limits of a signal (`allowed`, `min`, `max`).
#[derive(Clone, PartialEq, prost::Oneof)]
pub(crate) enum TypedValue {
    #[prost(string, tag = "11")]
    Text(String),
    #[prost(bool, tag = "12")]
    Flag(bool),
    #[prost(sint32, tag = "13")]
    Int32(i32),
    #[prost(sint64, tag = "14")]
    Int64(i64),
    #[prost(uint32, tag = "15")]
    Uint32(u32),
    #[prost(uint64, tag = "16")]
    Uint64(u64),
    #[prost(float, tag = "17")]
    Float(f32),
    #[prost(double, tag = "18")]
    Double(f64),
    #[prost(message, tag = "21")]
    Texts(Texts),
    #[prost(message, tag = "22")]
    Flags(Flags),
    #[prost(message, tag = "25")]
    Numbers(Numbers),
    #[prost(message, tag = "27")]
    Floats(Floats),
}

#[derive(Clone, PartialEq, Eq, prost::Message)]
pub(crate) struct Texts {
    #[prost(string, repeated, tag = "1")]
    pub(crate) values: Vec<String>,
}

#[derive(Clone, PartialEq, Eq, prost::Message)]
pub(crate) struct Flags {
    #[prost(bool, repeated, tag = "1")]
    pub(crate) values: Vec<bool>,
}

#[derive(Clone, PartialEq, Eq, prost::Message)]
pub(crate) struct Numbers {
    #[prost(uint32, repeated, tag = "1")]
    pub(crate) values: Vec<u32>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub(crate) struct Floats {
    #[prost(float, repeated, tag = "1")]
    pub(crate) values: Vec<f32>,
}

#[derive(Clone, PartialEq, Eq, prost::Message)]
pub(crate) struct ListMetadataRequest {
    #[prost(string, tag = "1")]
    pub(crate) root: String,
}

#[derive(Clone, PartialEq, prost::Message)]
pub(crate) struct ListMetadataResponse {
    #[prost(message, repeated, tag = "1")]
    pub(crate) metadata: Vec<Metadata>,
}

/// The broker's description of a signal.
#[derive(Clone, PartialEq, prost::Message)]
pub(crate) struct Metadata {
    #[prost(string, tag = "9")]
    pub(crate) path: String,
    /// Number of the signal. It is valid until the broker restarts.
    #[prost(int32, tag = "10")]
    pub(crate) id: i32,
    /// Number of the VSS datatype.
    #[prost(int32, tag = "11")]
    pub(crate) data_type: i32,
    #[prost(message, optional, tag = "17")]
    pub(crate) allowed: Option<Value>,
    #[prost(message, optional, tag = "18")]
    pub(crate) min: Option<Value>,
    #[prost(message, optional, tag = "19")]
    pub(crate) max: Option<Value>,
}

#[derive(Clone, Copy, PartialEq, Eq, prost::Message)]
pub(crate) struct SampleInterval {
    #[prost(uint32, tag = "1")]
    pub(crate) interval_ms: u32,
}

/// Claims signals. While the stream is open, no other program may provide them.
#[derive(Clone, PartialEq, Eq, prost::Message)]
pub(crate) struct ProvideSignalRequest {
    #[prost(btree_map = "int32, message", tag = "1")]
    pub(crate) signals: BTreeMap<i32, SampleInterval>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub(crate) struct PublishValuesRequest {
    #[prost(uint32, tag = "1")]
    pub(crate) request_id: u32,
    #[prost(btree_map = "int32, message", tag = "2")]
    pub(crate) data_points: BTreeMap<i32, Datapoint>,
}

/// This program's answer to a [`GetProviderValueRequest`].
#[derive(Clone, PartialEq, prost::Message)]
pub(crate) struct GetProviderValueResponse {
    #[prost(uint32, tag = "1")]
    pub(crate) request_id: u32,
    #[prost(btree_map = "int32, message", tag = "2")]
    pub(crate) entries: BTreeMap<i32, Datapoint>,
}

#[derive(Clone, PartialEq, prost::Message)]
pub(crate) struct ToBroker {
    #[prost(oneof = "Action", tags = "2, 4, 6")]
    pub(crate) action: Option<Action>,
}

#[derive(Clone, PartialEq, prost::Oneof)]
pub(crate) enum Action {
    #[prost(message, tag = "2")]
    Publish(PublishValuesRequest),
    #[prost(message, tag = "4")]
    Provide(ProvideSignalRequest),
    #[prost(message, tag = "6")]
    Answer(GetProviderValueResponse),
}

/// The broker's acceptance of a claim.
#[derive(Clone, Copy, PartialEq, Eq, prost::Message)]
pub(crate) struct ProvideSignalResponse {}

/// Values that the broker rejected. Accepted values have no response.
#[derive(Clone, PartialEq, Eq, prost::Message)]
pub(crate) struct PublishValuesResponse {
    #[prost(uint32, tag = "1")]
    pub(crate) request_id: u32,
    #[prost(btree_map = "int32, message", tag = "2")]
    pub(crate) status: BTreeMap<i32, Rejection>,
}

#[derive(Clone, PartialEq, Eq, prost::Message)]
pub(crate) struct Rejection {
    #[prost(int32, tag = "1")]
    pub(crate) code: i32,
    #[prost(string, tag = "2")]
    pub(crate) message: String,
}

/// A reader's request for values, which the broker forwards to this program. The broker waits a second for the answer.
#[derive(Clone, PartialEq, Eq, prost::Message)]
pub(crate) struct GetProviderValueRequest {
    #[prost(uint32, tag = "1")]
    pub(crate) request_id: u32,
    #[prost(int32, repeated, tag = "2")]
    pub(crate) signal_ids: Vec<i32>,
}

/// A message from the broker. Filters (tag 5), which ask for a slower rate, are ignored: this program publishes every
/// status document, because all readers see the same values.
#[derive(Clone, PartialEq, prost::Message)]
pub(crate) struct FromBroker {
    #[prost(oneof = "Event", tags = "2, 4, 6")]
    pub(crate) event: Option<Event>,
}

#[derive(Clone, PartialEq, prost::Oneof)]
pub(crate) enum Event {
    #[prost(message, tag = "2")]
    Rejected(PublishValuesResponse),
    #[prost(message, tag = "4")]
    Provided(ProvideSignalResponse),
    #[prost(message, tag = "6")]
    Asked(GetProviderValueRequest),
}

/// Calls over one connection.
#[derive(Debug, Clone)]
pub(crate) struct Client {
    grpc: Grpc<Channel>,
    authorization: Option<MetadataValue<Ascii>>,
}

impl Client {
    pub(crate) fn new(channel: Channel, authorization: Option<MetadataValue<Ascii>>) -> Self {
        Self { grpc: Grpc::new(channel), authorization }
    }

    /// Lists the signals at and below `root`.
    pub(crate) async fn list_metadata(&mut self, root: &str) -> Result<Vec<Metadata>, Status> {
        let mut request = Request::new(ListMetadataRequest { root: root.to_owned() });
        self.authorize(&mut request);
        self.ready().await?;
        let path = PathAndQuery::from_static("/kuksa.val.v2.VAL/ListMetadata");
        let response = self.grpc.unary(request, path, ProstCodec::<_, ListMetadataResponse>::default()).await?;
        Ok(response.into_inner().metadata)
    }

    /// Opens the provider stream.
    pub(crate) async fn open_provider_stream(
        &mut self,
        messages: impl Stream<Item = ToBroker> + Send + 'static,
    ) -> Result<Streaming<FromBroker>, Status> {
        let mut request = messages.into_streaming_request();
        self.authorize(&mut request);
        self.ready().await?;
        let path = PathAndQuery::from_static("/kuksa.val.v2.VAL/OpenProviderStream");
        Ok(self.grpc.streaming(request, path, ProstCodec::default()).await?.into_inner())
    }

    async fn ready(&mut self) -> Result<(), Status> {
        self.grpc.ready().await.map_err(|error| Status::unavailable(error.to_string()))
    }

    fn authorize<T>(&self, request: &mut Request<T>) {
        if let Some(authorization) = &self.authorization {
            request.metadata_mut().insert("authorization", authorization.clone());
        }
    }
}
