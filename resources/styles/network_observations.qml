<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="3.22.0" styleCategories="Symbology|Fields|AttributeTable">
  <renderer-v2 type="singleSymbol" symbollevels="0" referencescale="-1" enableorderby="0" forceraster="0">
    <symbols>
      <symbol type="line" clip_to_extent="1" name="0" force_rhr="0" alpha="1">
        <layer locked="0" class="SimpleLine" pass="0" enabled="1">
          <Option type="Map">
            <Option type="QString" value="round" name="capstyle" />
            <Option type="QString" value="round" name="joinstyle" />
            <Option type="QString" value="112,112,112,255" name="line_color" />
            <Option type="QString" value="solid" name="line_style" />
            <Option type="QString" value="0.5" name="line_width" />
            <Option type="QString" value="MM" name="line_width_unit" />
          </Option>
          <data_defined_properties>
            <Option type="Map">
              <Option type="QString" value="" name="name" />
              <Option type="Map" name="properties">
                <Option type="Map" name="outlineColor">
                  <Option type="bool" value="true" name="active" />
                  <Option type="QString" value="color_hsl((&quot;component&quot; * 137) % 360, 75, 42 + 8 * (&quot;component&quot; % 3))" name="expression" />
                  <Option type="int" value="3" name="type" />
                </Option>
              </Option>
              <Option type="QString" value="collection" name="type" />
            </Option>
          </data_defined_properties>
        </layer>
      </symbol>
    </symbols>
  </renderer-v2>
  <aliases>
    <alias name="Observation" field="observation" />
    <alias name="Component" field="component" />
    <alias name="Class" field="class" />
    <alias name="Source" field="source" />
    <alias name="Source feature" field="source_fid" />
    <alias name="Drive" field="drive" />
    <alias name="Local map" field="instance" />
  </aliases>
  <attributetableconfig actionWidgetStyle="dropDown" sortOrder="0" sortExpression="">
    <columns>
      <column type="field" name="observation" hidden="0" width="-1" />
      <column type="field" name="component" hidden="0" width="-1" />
      <column type="field" name="class" hidden="0" width="-1" />
      <column type="field" name="source" hidden="0" width="-1" />
      <column type="field" name="source_fid" hidden="0" width="-1" />
      <column type="field" name="drive" hidden="0" width="-1" />
      <column type="field" name="instance" hidden="0" width="-1" />
      <column type="field" name="fid" hidden="1" width="-1" />
      <column type="actions" hidden="1" width="-1" />
    </columns>
  </attributetableconfig>
  <layerGeometryType>1</layerGeometryType>
</qgis>
