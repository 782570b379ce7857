//! Messages about clips: what a vehicle announces, what the cloud wants of it, and what people see.
//!
//! A vehicle sends a [`ClipReport`] to `POST /v1/clips` and gets [`ClipOrders`], the complete list
//! of what the cloud still wants, best first. It sends files in pieces to
//! `PUT /v1/clips/NAME/from/BYTE`, and images to `PUT /v1/clips/NAME/thumbnail`. Of a piece that
//! breaks off, the cloud keeps what has come. Older vehicles send parts of [`CLIP_PART`] bytes to
//! `PUT /v1/clips/NAME/parts/NUMBER/SHA256`.

use std::fmt;
use std::str::FromStr;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

/// Length of each part of a file but the last one, and of the longest piece.
pub const CLIP_PART: u64 = 8 << 20;
/// Shortest piece that the cloud keeps, unless the file ends with it.
pub const CLIP_PIECE_MIN: u64 = 4 << 10;
/// Longest clip: no recorder writes a longer one at once.
pub const CLIP_MAX: u64 = 64 << 30;
/// Longest thumbnail.
pub const THUMBNAIL_MAX: u64 = 256 << 10;
/// Maximum length of a [`ClipReport`] as JSON.
pub const CLIP_REPORT_MAX: usize = 1 << 20;
/// Maximum length of [`ClipFacts`] as JSON.
pub const CLIP_FACTS_MAX: usize = 64 << 10;
/// Maximum number of clips in a report.
pub const CLIPS_IN_REPORT: usize = 64;
/// Maximum number of moments, lambdas and texts of a clip.
const ENTRIES_MAX: usize = 256;
/// Maximum length of a short text: a name, a label, or a position.
const TEXT_MAX: usize = 256;
/// Maximum length of a name of a clip.
const NAME_MAX: usize = 200;

/// The name of a clip at its vehicle, without `.mcap`. It is always safe as a part of a path.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "String", into = "String")]
pub struct ClipName(String);

impl ClipName {
    /// Returns the name as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl FromStr for ClipName {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let allowed = |c: char| c.is_ascii_alphanumeric() || "._-".contains(c);
        let is_name = (1..=NAME_MAX).contains(&text.len())
            && text.chars().all(allowed)
            && !text.starts_with('.');
        match is_name {
            true => Ok(Self(text.to_owned())),
            false => Err(format!("`{}` is not a clip name", gleaner_base::excerpt(text))),
        }
    }
}

impl fmt::Display for ClipName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl TryFrom<String> for ClipName {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl From<ClipName> for String {
    fn from(name: ClipName) -> Self {
        name.0
    }
}

/// The id of a clip in the fleet: `NAME@VEHICLE`.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "String", into = "String")]
pub struct ClipId {
    name: ClipName,
    vehicle: ClipName,
}

impl ClipId {
    /// Returns the id of a clip of a vehicle.
    ///
    /// # Errors
    ///
    /// The reason, if the vehicle has a name that is not safe as a part of a path.
    pub fn new(name: ClipName, vehicle: &str) -> Result<Self, String> {
        let vehicle = vehicle
            .parse()
            .map_err(|_| format!("`{}` is not a vehicle name", gleaner_base::excerpt(vehicle)))?;
        Ok(Self { name, vehicle })
    }

    /// Returns the name of the clip.
    pub fn name(&self) -> &str {
        self.name.as_str()
    }

    /// Returns the name of the vehicle.
    pub fn vehicle(&self) -> &str {
        self.vehicle.as_str()
    }
}

impl FromStr for ClipId {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts = text.rsplit_once('@');
        let parsed = parts.and_then(|(name, vehicle)| Self::new(name.parse().ok()?, vehicle).ok());
        parsed.ok_or_else(|| {
            let text = gleaner_base::excerpt(text);
            format!("`{text}` is not a clip id, as in brake-20260802T083451.136Z@car-7")
        })
    }
}

impl fmt::Display for ClipId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}@{}", self.name, self.vehicle)
    }
}

impl TryFrom<String> for ClipId {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl From<ClipId> for String {
    fn from(id: ClipId) -> Self {
        id.to_string()
    }
}

/// The facts of a clip, as its vehicle states them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ClipFacts {
    /// Its name.
    pub name: ClipName,
    /// Begin of the earliest window, in ns since 1970.
    pub from_ns: i64,
    /// End of the latest window.
    pub to_ns: i64,
    /// Length of the file, in bytes.
    pub bytes: u64,
    /// SHA-256 of the file; `None` if the vehicle had deleted it before it could be read.
    pub sha256: Option<String>,
    /// SHA-256 of the thumbnail, a JPEG; `None` without one.
    pub thumbnail: Option<String>,
    /// The lambdas whose windows it contains.
    pub lambdas: Vec<RecordedLambda>,
    /// Number of triggers and commands in it; `moments` may have fewer.
    pub triggers: u64,
    /// The first triggers and commands.
    pub moments: Vec<ClipMoment>,
    /// The reasons why it has less than was requested.
    #[serde(default)]
    pub incomplete: Vec<String>,
    /// True if the recorder died, and a later one recovered the clip.
    #[serde(default)]
    pub is_recovered: bool,
    /// The reason why the vehicle cannot read the file now; it has no `sha256` until it can.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unreadable: Option<String>,
}

/// A lambda of a clip.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct RecordedLambda {
    /// Its name.
    pub name: String,
    /// Its version.
    pub version: String,
    /// SHA-256 over the files of its build.
    pub digest: String,
    /// Id of its deployment; `None` if the vehicle does not have that any more.
    pub deployment: Option<String>,
    /// Digest of its revision; `None` if the vehicle does not have that any more.
    pub revision: Option<String>,
}

/// A trigger or a command of a clip.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ClipMoment {
    /// Name of the lambda.
    pub lambda: String,
    /// `event`, `start` or `stop`.
    pub kind: String,
    /// The lambda's name for the event.
    pub label: String,
    /// Confidence or strength.
    pub score: Option<f64>,
    /// Further values; `None` if they were too long for the list of clips.
    pub attributes: Option<Map<String, Value>>,
    /// Time, in ns since 1970.
    pub at_ns: i64,
    /// Origin of a moment that the lambda did not cause.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub source: Option<String>,
}

impl ClipFacts {
    /// Checks the lengths of all parts, and that digests are ones.
    ///
    /// # Errors
    ///
    /// The reason, if a part is not as it must be.
    pub fn check(&self) -> Result<(), String> {
        let Self { name, lambdas, moments, incomplete, .. } = self;
        let is_digest =
            |text: &String| text.len() == 64 && text.bytes().all(|b| b.is_ascii_hexdigit());
        let lambda_texts = lambdas.iter().flat_map(|it| {
            let own = [Some(&it.name), Some(&it.version), Some(&it.digest)];
            own.into_iter().chain([it.deployment.as_ref(), it.revision.as_ref()]).flatten()
        });
        let moment_texts = moments.iter().flat_map(|it| {
            [Some(&it.lambda), Some(&it.kind), Some(&it.label), it.source.as_ref()]
                .into_iter()
                .flatten()
        });
        let mut digests = self.sha256.iter().chain(&self.thumbnail);
        let reason = match () {
            () if self.bytes > CLIP_MAX => "its file is too long",
            () if self.from_ns > self.to_ns => "it ends before it begins",
            () if !digests.all(is_digest) => "invalid SHA-256 digest",
            () if [lambdas.len(), moments.len(), incomplete.len()]
                .iter()
                .any(|count| *count > ENTRIES_MAX) =>
            {
                "it has too many entries"
            }
            () if lambda_texts
                .chain(moment_texts)
                .chain(&self.unreadable)
                .any(|text| text.len() > TEXT_MAX) =>
            {
                "a text is too long"
            }
            () if moments.iter().any(|it| it.score.is_some_and(|score| !score.is_finite())) => {
                "score is not a finite number"
            }
            () if self.length() > CLIP_FACTS_MAX => "its facts are too long",
            () => return Ok(()),
        };
        Err(format!("clip `{name}`: {reason}"))
    }

    /// Returns the length of the longest piece that begins at a byte; `None` beyond the end.
    pub fn piece_length(bytes: u64, begin: u64) -> Option<u64> {
        bytes.checked_sub(begin).filter(|rest| *rest > 0).map(|rest| rest.min(CLIP_PART))
    }

    /// Shortens texts and lists until the facts fit into a report.
    pub fn shorten(&mut self) {
        let cut = |text: &mut String| {
            let end = (0..=TEXT_MAX.min(text.len())).rev().find(|end| text.is_char_boundary(*end));
            text.truncate(end.unwrap_or(0));
        };
        self.lambdas.truncate(ENTRIES_MAX);
        self.moments.truncate(ENTRIES_MAX);
        self.incomplete.truncate(16);
        self.incomplete.iter_mut().chain(&mut self.unreadable).for_each(cut);
        for lambda in &mut self.lambdas {
            [&mut lambda.name, &mut lambda.version, &mut lambda.digest].into_iter().for_each(cut);
        }
        for moment in &mut self.moments {
            [&mut moment.lambda, &mut moment.kind, &mut moment.label].into_iter().for_each(cut);
            moment.source.iter_mut().for_each(cut);
        }
        while self.length() > CLIP_FACTS_MAX && self.moments.pop().is_some() {}
    }

    /// Returns the length as JSON.
    pub fn length(&self) -> usize {
        serde_json::to_vec(self).map_or(usize::MAX, |text| text.len())
    }
}

/// A report of a vehicle about its clips.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ClipReport {
    /// Its position in its list of clips after these; `None` if it only asks for orders.
    pub cursor: Option<String>,
    /// Clips that are new since the position that the cloud has.
    pub clips: Vec<ClipFacts>,
    /// Clips or thumbnails that the cloud wants and that are not there any more.
    pub gone: Vec<GoneClip>,
}

/// A clip whose file is not there any more.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct GoneClip {
    /// Its name.
    pub name: ClipName,
    /// True if only the thumbnail is gone.
    pub is_thumbnail: bool,
    /// The reason.
    pub reason: String,
}

/// Everything that the cloud wants of the clips of a vehicle.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct ClipOrders {
    /// The newest position that is durable.
    pub cursor: Option<String>,
    /// Clips whose thumbnails it lacks.
    pub thumbnails: Vec<ClipName>,
    /// Clips whose files it lacks, the most important first.
    pub wanted: Vec<WantedClip>,
    /// Clips that the vehicle could not read, and reads again, also after a restart: at most as
    /// many as in a report, the pulled ones first. An older cloud states none.
    #[serde(default)]
    pub unreadable: Vec<ClipName>,
    /// Bytes that the vehicle may send. An older cloud states none.
    #[serde(default)]
    pub budget: Option<ClipBudget>,
}

/// Bytes of clips that a vehicle may send in a day, those that do not arrive too.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct ClipBudget {
    /// Number of the day, by the clock of the cloud: with another one, the count begins again.
    pub day: u64,
    /// Number of bytes in that day.
    pub bytes: u64,
    /// True if as many have arrived: then nothing is wanted.
    #[serde(default)]
    pub is_spent: bool,
}

/// A clip whose file the cloud wants.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct WantedClip {
    /// Its name.
    pub name: ClipName,
    /// Length of the file, as announced.
    pub bytes: u64,
    /// SHA-256 of the file, as announced.
    pub sha256: String,
    /// Number of the next part.
    pub part: u64,
    /// Number of bytes that the cloud has; an older one states none, and takes whole parts only.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub from: Option<u64>,
}

/// A clip of the fleet.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct FleetClip {
    /// Its id.
    pub id: ClipId,
    /// The vehicle.
    pub vehicle: String,
    /// Its state.
    pub state: ClipState,
    /// Number of bytes of the file that the cloud has.
    pub received: u64,
    /// The reason of the state, if there is one.
    pub reason: Option<String>,
    /// True if `/thumbnail` has an image.
    pub has_thumbnail: bool,
    /// Its facts.
    #[serde(flatten)]
    pub facts: ClipFacts,
}

/// The place of the file of a clip.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum ClipState {
    /// On its vehicle only.
    OnVehicle,
    /// On its vehicle, and the cloud wants it.
    Wanted,
    /// On its way to the cloud.
    Uploading,
    /// In the cloud.
    Stored,
    /// Nowhere: the vehicle has deleted it.
    Gone,
    /// On its vehicle, but not as announced, or the vehicle cannot read it.
    Failed,
}

impl ClipState {
    /// Returns its name.
    pub fn as_str(self) -> &'static str {
        match self {
            ClipState::OnVehicle => "on-vehicle",
            ClipState::Wanted => "wanted",
            ClipState::Uploading => "uploading",
            ClipState::Stored => "stored",
            ClipState::Gone => "gone",
            ClipState::Failed => "failed",
        }
    }
}

/// Rules for the upload of clips of the fleet.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ClipPolicy {
    /// The clips that are uploaded.
    pub upload: UploadedClips,
    /// Number of bytes that each vehicle sends in a day of UTC: of files and thumbnails, and of
    /// requests that did not arrive in full; each counts as 4 KiB at least.
    pub day_bytes: u64,
    /// Time after which a stored clip is removed, in s; 0 without a bound.
    #[serde(default)]
    pub keep_s: u64,
    /// Number of bytes of stored clips, with thumbnails and entries, above which the oldest are
    /// removed; 0 without a bound.
    #[serde(default)]
    pub keep_bytes: u64,
}

/// The clips in the cloud, and those that were removed.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct ClipUsage {
    /// Number of clips that are stored.
    pub stored: u64,
    /// Bytes of their files.
    pub bytes: u64,
    /// Number of clips that were removed, by people and by the rules.
    pub removed: u64,
    /// Bytes of their files.
    pub removed_bytes: u64,
    /// Bytes that all clips have on the disk: files, thumbnails, entries, uploads that are
    /// unfinished, and files that are not removed yet.
    #[serde(default)]
    pub disk_bytes: u64,
}

/// The clips that vehicles upload.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum UploadedClips {
    /// All of them.
    All,
    /// Those that a person wants.
    OnDemand,
    /// None.
    None,
}

impl UploadedClips {
    /// Returns its name.
    pub fn as_str(self) -> &'static str {
        match self {
            UploadedClips::All => "all",
            UploadedClips::OnDemand => "on-demand",
            UploadedClips::None => "none",
        }
    }

    /// Returns whether a clip is one of them; `is_requested` if a person wants it.
    pub fn wants(self, is_requested: bool) -> bool {
        match self {
            UploadedClips::All => true,
            UploadedClips::OnDemand => is_requested,
            UploadedClips::None => false,
        }
    }
}

impl FromStr for UploadedClips {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let all = [UploadedClips::All, UploadedClips::OnDemand, UploadedClips::None];
        all.into_iter().find(|it| it.as_str() == text).ok_or_else(|| {
            let text = gleaner_base::excerpt(text);
            format!("`{text}` is not a choice of clips; use `all`, `on-demand` or `none`")
        })
    }
}

#[cfg(test)]
mod tests;
