//! Formats clips.

use std::fmt::{self, Write};

use gleaner_base::visible;
use gleaner_lambda::Clip;
use gleaner_protocol::ReplaySummary;
use gleaner_report::format::{clip_contents, clip_span, counted, seconds};

use super::{Paint, SHOWN, more};

/// Writes a block for each clip: its time, contents and gaps.
pub(super) fn write(
    text: &mut String,
    clips: &[Clip],
    summary: &ReplaySummary,
    paint: Paint,
) -> fmt::Result {
    if clips.is_empty() {
        return Ok(());
    }
    writeln!(text, "  {}", paint.bold(&counted(clips.len() as u64, "clip")))?;
    for clip in clips.iter().take(SHOWN) {
        let [from, to] = clip_span(clip).map(|at_ns| seconds(at_ns, summary.start_ns));
        one(text, clip, &format!("{from:>10.3} to {to:.3} s"), paint)?;
    }
    more(text, (clips.len() as u64).saturating_sub(SHOWN as u64))
}

/// Writes a block for one clip, headed by its time `when`.
pub(super) fn one(text: &mut String, clip: &Clip, when: &str, paint: Paint) -> fmt::Result {
    let file = visible(&clip.file.to_string_lossy());
    writeln!(text, "{}  {file}", paint.green(when))?;
    let thumbnail =
        clip.thumbnail.as_ref().map(|path| format!("; {}", visible(&path.to_string_lossy())));
    writeln!(text, "{:>14}{}{}", "", clip_contents(clip), thumbnail.unwrap_or_default())?;
    let incomplete = clip.incomplete.iter().map(|why| format!("incomplete: {}", visible(why)));
    // Losses of the recorder itself are in `incomplete`.
    let lost = clip.topics.iter().filter_map(|topic| {
        let lost = counted(topic.lost.filter(|lost| *lost > 0)?, "message");
        Some(format!("lost: {lost} of {}, upstream", visible(&topic.topic)))
    });
    let recovered = clip.recovered.as_ref().map(|recovered| {
        let lost = counted(recovered.lost_bytes, "byte");
        format!("recovered: {} ({lost} lost)", visible(&recovered.note))
    });
    let mut notes = incomplete.chain(lost).chain(recovered);
    notes.try_for_each(|note| writeln!(text, "{:>14}{}", "", paint.yellow(&note)))
}
