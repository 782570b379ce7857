//! Makes a page of measurements: tables, and plots of their distributions or their growth.

use serde::Serialize;

use crate::page::{MEASUREMENT_SCRIPTS, html};

/// A page of measurements.
#[derive(Debug, Clone, Serialize)]
pub struct MeasurementPage {
    /// Its title.
    pub title: String,
    /// The origin of the measurements, in a line below the title.
    pub origin: String,
    /// Facts about the machine: name and value.
    pub facts: Vec<(String, String)>,
    /// Sentences that a reader needs to understand the tables.
    pub notes: Vec<String>,
    /// Sentences that follow from the numbers.
    pub recommendation: Vec<String>,
    /// Its parts.
    pub sections: Vec<MeasurementSection>,
}

/// A part of a page.
#[derive(Debug, Clone, Serialize)]
pub struct MeasurementSection {
    /// Its title.
    pub title: String,
    /// A few words beside the title.
    pub note: String,
    /// Its plots.
    pub plots: Vec<Plot>,
    /// Its tables, below the plots.
    pub tables: Vec<PlotTable>,
}

/// Curves over a common axis.
#[derive(Debug, Clone, Serialize)]
pub struct Plot {
    /// Label of the horizontal axis.
    pub x: String,
    /// Label of the vertical axis.
    pub y: String,
    /// True if the horizontal axis is logarithmic.
    pub is_x_logarithmic: bool,
    /// The curves.
    pub curves: Vec<PlotCurve>,
}

/// A curve.
#[derive(Debug, Clone, Serialize)]
pub struct PlotCurve {
    /// Its name in the legend.
    pub name: String,
    /// Its points, from left to right.
    pub points: Vec<[f64; 2]>,
}

/// A table of texts.
#[derive(Debug, Clone, Serialize)]
pub struct PlotTable {
    /// The heads of its columns.
    pub heads: Vec<String>,
    /// Its rows, each with a cell for each head.
    pub rows: Vec<Vec<String>>,
}

impl MeasurementPage {
    /// Renders the page as one file in UTF-8. It loads nothing, and runs no script but its own.
    pub fn to_html(&self) -> String {
        html(self, MEASUREMENT_SCRIPTS)
    }
}
