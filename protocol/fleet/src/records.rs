//! Records that a search of a cloud finds.

use gleaner_protocol::vehicle_api::StreamLine;
use serde::{Deserialize, Serialize};

/// A record that a search has found, with its vehicle.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct FoundRecord {
    /// The vehicle.
    pub vehicle: String,
    /// The record.
    pub line: StreamLine,
}

/// A part of what a search finds: of each vehicle the newest first, and all of a vehicle before the
/// next one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct FoundRecords {
    /// The records; a part may have none, and still go on.
    pub items: Vec<FoundRecord>,
    /// The value of `after` for the next part; absent at the end.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next: Option<String>,
}
