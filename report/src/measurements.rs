//! Makes a page of measurements: tables, and plots of their distributions or their growth.

use serde::Serialize;

use crate::page::{MEASUREMENT_SCRIPTS, html};

#[derive(Debug, Clone, Serialize)]
pub struct MeasurementPage {
    pub title: String,
    /// The origin of the measurements, in a line below the title.
    pub origin: String,
    /// Facts about the machine: name and value.
    pub facts: Vec<(String, String)>,
    /// Sentences that a reader needs to understand the tables.
    pub notes: Vec<String>,
    /// Sentences that follow from the numbers.
    pub recommendation: Vec<String>,
    pub sections: Vec<MeasurementSection>,
}

#[derive(Debug, Clone, Serialize)]
pub struct MeasurementSection {
    pub title: String,
    /// A few words beside the title.
    pub note: String,
    pub plots: Vec<Plot>,
    pub tables: Vec<PlotTable>,
}

/// Curves over a common axis.
#[derive(Debug, Clone, Serialize)]
pub struct Plot {
    /// Label of the horizontal axis.
    pub x: String,
    /// Label of the vertical axis.
    pub y: String,
    pub is_x_logarithmic: bool,
    pub curves: Vec<PlotCurve>,
}

#[derive(Debug, Clone, Serialize)]
pub struct PlotCurve {
    pub name: String,
    /// Its points, from left to right.
    pub points: Vec<[f64; 2]>,
}

#[derive(Debug, Clone, Serialize)]
pub struct PlotTable {
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
